"""What people turn bolts from: turns, sheets for the ladder, the mirror with its turns."""
