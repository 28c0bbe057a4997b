"""`python -m benchmarks.faults`, once for the kinds without Ray; the tests of sharded indexes cover the others."""

import json

import pytest

from benchmarks import faults


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_builds_that_are_killed_refused_and_torn_lose_nothing(monkeypatch, capsys):
    pytest.importorskip("moto.server", reason="needs moto[server]")
    pytest.importorskip("s3fs", reason="needs s3fs")
    monkeypatch.setattr("sys.argv", ["faults", "--times", "1", "--only", "job", "refusals", "torn"])
    assert faults.main() == 0
    figures = {line["kind"]: line for line in map(json.loads, capsys.readouterr().out.splitlines())}
    assert figures["job"]["killed"] == 2
    assert figures["job"]["same_repeated_most"] == 0
    assert figures["job"]["other_repeated_most"] < faults.PHOTOS / 2
    assert figures["refusals"]["refused"] >= 1
    assert figures["torn"]["torn"] >= 1


def test_a_lost_duplicated_or_changed_photo_is_detected():
    """The check of codes, on sets made by hand."""
    bench = object.__new__(faults.FaultFixture)
    bench.codes = {"a": ("mug", faults.np.zeros(2)), "b": ("tin", faults.np.ones(2))}
    for found in (
        {"a": bench.codes["a"]},
        bench.codes | {"a": ("tin", faults.np.zeros(2))},
        bench.codes | {"b": ("tin", faults.np.full(2, 1.1))},
    ):
        bench.codes_of = lambda cluster, found=found: found
        with pytest.raises(faults.ExpectationFailed):
            bench.check_codes(None)
    bench.codes_of = lambda cluster: dict(bench.codes)
    bench.check_codes(None)
