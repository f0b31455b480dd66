"""What `namod-ctl lut` does: its files, its words, and how a table is applied."""
