"""The letters of a touch's images are exactly a, b and so on, each once; a near miss is neither photo nor touch."""

from retrieval.data.catalogue import list_catalogue
from tests.as_they_come import write_pictures

NEARLY = ["Touch_3_a.jpg", "touch-3-a.png", "touch 3 b.png", "TOUCH_3_A.png", "touch_3_A.png", "touch_3_a (1).png"]
PHOTOS = ["front.jpg", "touchscreen.jpg", "touch.jpg", "touch-up pen.jpg", "retouch_1_a.jpg"]


def check(folder, get):
    exact = ["touch_0_a.png", "touch_0_b.jpg", "touch_1.png"]
    twice, gap = ["touch_4_a.jpg", "touch_4_a.png"], ["touch_5_a.png", "touch_5_c.png"]
    write_pictures(folder / "mug", *exact, *twice, *gap, *NEARLY, *PHOTOS)
    catalogue = list_catalogue(folder)
    assert sorted(photo.path for photo in catalogue.photos) == sorted(f"mug/{name}" for name in PHOTOS)
    assert [touch.paths for touch in catalogue.touches] == [
        ("mug/touch_0_a.png", "mug/touch_0_b.jpg"),
        ("mug/touch_1.png",),
    ]
    reasons = {item.path: item.reason for item in catalogue.skipped}
    assert reasons.keys() == {f"mug/{name}" for name in (*twice, *gap, *NEARLY)}
    assert all("touch_<name>_a" in reason for reason in reasons.values())
