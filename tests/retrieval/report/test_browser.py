"""The page of an evaluation in a real browser, from the disk."""

import pytest

from retrieval.report.evaluation import write_report
from tests.browser import chromium, page, serious
from tests.synthetic_evaluation import write_synthetic_results


@pytest.mark.slow
def test_axe_finds_nothing_serious(tmp_path):
    out = write_synthetic_results(tmp_path, ("late_fusion", "cca", "chance"))
    write_report(out)
    with chromium() as browser, page(browser, (out / "report.html").as_uri(), offline=True) as opened:
        assert serious(opened) == []
