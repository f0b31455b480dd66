"""Directions of a camera's pixels: from star fields, trails and chessboards; and the telescope's optical axis."""
