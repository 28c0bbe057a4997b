"""PhysiCLeAR: identify the pressed object part from other press videos of it."""

from retrieval.evaluation.touch_to_touch import TouchToTouch

LEAVE_ONE_VIDEO_OUT = TouchToTouch(
    "physiclear",
    "PhysiCLeAR: touch to touch, one video left out",
    "Each press video is the query once. The gallery contains the other videos of all parts; the nearest one gives "
    "the part. Nothing is trained. A video is the mean of its frames of strongest contact. The videos of a part were "
    "recorded one after the other. The order of capture is that of the file names, part by part, as no times are "
    "published.",
)
