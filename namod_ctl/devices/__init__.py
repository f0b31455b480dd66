"""Hardware, and only here: transports, links and drives."""
