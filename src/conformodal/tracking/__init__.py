"""Motion between frames: corners, flow, two-view geometry and submaps (OpenCV, PoseLib)."""
