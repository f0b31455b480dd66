"""A camera's answer to light and to darkness: series at a lamp, the radiometric law, dark frames."""
