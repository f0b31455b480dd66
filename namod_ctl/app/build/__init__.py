"""The composition root: from a config to the objects that the program works with."""
