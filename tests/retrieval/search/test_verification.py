"""`Searcher.verify` and `retrieve verify`: accept, reject, another grasp, and invalid requests."""

import json

import pytest

import retrieval
from retrieval.commands.main import main
from retrieval.errors import BadInput
from retrieval.model.verification import MAX_GRASPS
from tests.verification import calibration, verified_index


@pytest.fixture(scope="module")
def open_index(model, catalogue, tmp_path_factory):
    """Return a function that builds and opens an index of a model with a calibration."""

    def opened(fitted):
        return retrieval.open(verified_index(tmp_path_factory.mktemp("verified"), model, catalogue, fitted))

    return opened


@pytest.fixture(scope="module")
def ratio(open_index, touches):
    """The log likelihood ratio of the first object for its first touch: the logit of its photos."""
    name = sorted(touches)[0]
    with open_index(None) as searcher:
        result = searcher.query(touches[name][:1], top=99)
        return next(match.logit for match in result.results if match.object_id == name)


@pytest.mark.parametrize(
    ("accept", "reject", "decision"), [(-1, -2, "accept"), (2, 1, "reject"), (1, -1, "another grasp")]
)
def test_the_ratio_of_the_expected_object_is_compared_with_the_bounds(
    open_index, touches, ratio, accept, reject, decision
):
    name = sorted(touches)[0]
    with open_index(calibration(ratio + accept, ratio + reject)) as searcher:
        found = searcher.verify(touches[name][:1], name, far=0.05)
        assert found.decision == decision
        assert found.log_ratios == [pytest.approx(ratio, abs=1e-4)]
        assert found.sentence.startswith(decision)


def test_a_sequence_that_ends_without_a_decision_is_rejected(open_index, touches, ratio):
    name, other = sorted(touches)[:2]
    grasps = [*touches[name], touches[other][0]]
    assert len(grasps) == MAX_GRASPS
    with open_index(calibration(1e3, -1e3)) as searcher:
        assert searcher.verify(grasps[:-1], name).decision == "another grasp"
        found = searcher.verify(grasps, name)
        assert found.decision == "reject"
        assert len(found.log_ratios) == MAX_GRASPS


def test_the_command_prints_the_decision_and_exits_with_its_code(open_index, touches, capsys):
    name = sorted(touches)[0]
    with open_index(calibration(-1e3, -2e3)) as searcher:
        index = str(searcher.index)
    images = [str(path) for path in touches[name][0]]
    assert main(["verify", "--expect", name, "--gelsight", *images, "--index", index, "--json"]) == 0
    output = capsys.readouterr()
    document = json.loads(output.out)
    assert document["decision"] == "accept"
    assert document["bounds"]["false_accepts"]["value"] == 0.01
    assert f"accept: {name}" in output.err
    assert main(["verify", "--expect", "anvil", "--gelsight", *images, "--index", index]) == 2
    assert "has no object 'anvil'" in capsys.readouterr().err
    assert main(["verify", "--expect", name, "--gelsight", *images, "--index", index, "--far", "0.00001"]) == 2
    assert "validation objects; the model has 100" in capsys.readouterr().err
    with open_index(None) as searcher, pytest.raises(BadInput, match="no error rates for verification"):
        searcher.verify(touches[name][:1], name)
