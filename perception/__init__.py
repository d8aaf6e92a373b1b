"""From a camera frame to part poses: calibration, segmentation, keypoints, refinement. Imports no MuJoCo."""
