"""The sky as a camera on the ground sees it: bright stars, their places, their paths."""
