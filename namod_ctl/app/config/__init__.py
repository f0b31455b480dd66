"""The instrument's config: its schema, how it is read, what is wrong with it, and what it says."""
