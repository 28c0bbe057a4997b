"""A picture is evidence once: given again, in another form or for both fingers, it is refused by name."""

import pytest
from PIL import Image

from retrieval.errors import BadInput
from retrieval.search.searcher import Searcher


def check(folder, get):
    a, b = get("touch")
    pixels = Image.open(b).convert("RGB")
    pixels.save(folder / "copy.bmp")
    with Searcher.open(get("index")) as searcher:
        for touches in ([[a, b], [a, b]], [[a, b], [b, a]], [[a, b], [a, folder / "copy.bmp"]], [a, a]):
            with pytest.raises(BadInput, match="counts once"):
                searcher.query(touches)
        name = searcher.query([a, b]).results[0].object_id
        assert len(searcher.query_many([[a, b], [a, b]])) == 2  # two queries
        if searcher.can_verify:
            with pytest.raises(BadInput, match="counts once"):
                searcher.verify([[a, b], [a, b]], name)
