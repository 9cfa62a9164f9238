"""From an image to one belief about its pose: pose sources behind one protocol, and their fusion."""
