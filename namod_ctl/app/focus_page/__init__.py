"""The page of `namod-ctl camera focus`: the star's size, for the phone of whoever turns the lens."""
