"""EstimateModulus: GelSight Wedge videos of presses between the jaws of a gripper, on several days, without photos.

    <date>/<object>_<k>.avi    <date>/<object>__t=<k>.avi    the first frame is without contact (extra `importers`)

The folders can also be in `example_data/`. A date is a session, a video a sequence; an object has the same name on each
day. A video provides `frames` grasps (default 5): the frames that differ most from the first one, in order of time. The
first frame is their no-contact frame.
"""

import re
from pathlib import Path

from robot.importers.importing import NOT_STATED, DataSet, Progress, numbered_files, subfolders
from robot.importers.press_videos import NO_PHOTOS, Press, import_presses
from robot.recording.folder import Recording, safe_name

DATA_SET = DataSet(
    source="github.com/GelSight-lab/EstimateModulus",
    licence=NOT_STATED,
    terms="its repository states none, the card of its data set elsewhere says MIT; we do not pass the videos on",
    citation="Burgess, Zhao, Willemet, Learning Object Compliance via Young's Modulus from Single Grasps using "
    "Camera-Based Tactile Sensors, arXiv 2406.15304",
    sensor="GelSight Wedge",
    rig="parallel gripper; one of its fingers is the sensor",
    expects="`<date>/<object>_<k>.avi` or `<date>/<object>__t=<k>.avi`, or `example_data/` with these folders",
    background="the first frame of each video",
    caveats=(
        NO_PHOTOS,
        "Gel and lamps differ visibly between the days: compare touches of one day with those of another, and print "
        "the no-contact frame and the low-pass control beside each result.",
        "Few objects were pressed on two days, three times each: presses of one object are not independent, so "
        "resample objects, and state the counts.",
        "The image also shows a mirror, at the right.",
    ),
    unverified=("that the first frame of every video is without contact",),
)
_DATE = re.compile(r"\d{4}-\d\d-\d\d")
_VIDEO = re.compile(r"(?P<object>.+?)_(?:_t=)?(?P<press>\d{1,9})\.avi", re.IGNORECASE)


def import_estimate_modulus(src: Path, out: Path, progress: Progress | None = None, *, frames: int = 5) -> Recording:
    """Import `frames` grasps of each video in the folders of dates in `src`.

    Raises:
        ImporterError: There is no video, or av is missing.
    """
    days = subfolders(src / "example_data" if (src / "example_data").is_dir() else src)
    presses = [
        Press(match["object"], safe_name(day.name, match["object"], match["press"]), path, day.name)
        for day in days
        if _DATE.fullmatch(day.name)
        for match, path in numbered_files(day, _VIDEO)
    ]
    return import_presses(DATA_SET, presses, src, out, progress, frames)
