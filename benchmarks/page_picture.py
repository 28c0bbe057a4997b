"""Make docs/images/page.jpg: the page of the service with an answer from the index of a demo.

    retrieve demo && python -m benchmarks.page_picture demo

It uses the demo's own object and two of its grasps, so the choice does not depend on the answer.
"""

import argparse
import io
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

from PIL import Image

from retrieval.commands.demo import PHOTOS, example_object
from retrieval.data.dataset import load_grasps
from retrieval.serve.rig import simulated_live_rig
from tests.browser import address, ask, chromium, page
from tests.serving import with_history

OUT = Path(__file__).parents[1] / "docs" / "images" / "page.jpg"
SIZE = {"width": 1280, "height": 960}
GRASPS = 2


def main():
    """Query the page in Chromium and save a screenshot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("demo", type=Path, help="folder that `retrieve demo` wrote")
    folder = parser.parse_args().demo
    queries = defaultdict(list)
    for grasp in load_grasps(folder / "recording"):
        queries[grasp.object_id].append(grasp)
    queries = {name: grasps[PHOTOS:] for name, grasps in queries.items()}
    files = [path for grasp in queries[example_object(queries)][:GRASPS] for path in grasp.touches]
    index = folder / "index"
    with (
        tempfile.TemporaryDirectory() as history,
        with_history(index, Path(history), folder / "recording", simulated_live_rig(index), address) as url,
        chromium() as browser,
        page(browser, url) as opened,
    ):
        opened.set_viewport_size(SIZE)
        ask(opened, files)
        opened.locator(".answer").get_by_text("gives the most information").wait_for()
        opened.wait_for_load_state("networkidle")
        Image.open(io.BytesIO(opened.screenshot())).convert("RGB").save(OUT, quality=86, optimize=True)


if __name__ == "__main__":
    sys.exit(main())
