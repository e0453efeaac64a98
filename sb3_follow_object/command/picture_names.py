"""The pictures of a run's folder by their names."""

CURVE, TASK, IMAGINED, VIDEO = "curve.png", "task.png", "imagined.png", "video.mp4"
