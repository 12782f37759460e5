"""Points in space, markers or keypoints: TRC, C3D, CSV and arrays."""
