"""PnP on landmarks: corners of keyframes, triangulated, and poses of other images from the ones they match."""
