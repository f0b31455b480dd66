"""How gravity turns facets over zenith distance, tables of corrections, and the scatter that is left."""
