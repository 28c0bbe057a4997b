"""attempts.jsonl: its valid lines after a crash, and acceptance by object."""

import json

import pytest

from robot.errors import RecordingError
from robot.recording.attempt_log import AttemptLog, LoggedAttempt, acceptance_table, read_attempts, tally

HELD = LoggedAttempt("mug", 0, "held", True, 12.5, "mug-0000", 0.75, {"method": "circle", "radius_mm": 30.5})
NO_PLAN = LoggedAttempt("mug", 1, "no_plan", False, 13.0, reason="the object is wider than the stroke")
MISSED = LoggedAttempt("mug", 2, "missed", False, 20.0, "mug-0002", 0.0)
SLIPPED = LoggedAttempt("cup, blue", 0, "slipped", True, 31.0, "cup-0000", 1.0)
ALL = (HELD, NO_PLAN, MISSED, SLIPPED)
GRASPS = {attempt.grasp_id for attempt in ALL} - {None}


def write(folder, attempts=ALL, grasps=GRASPS):
    with AttemptLog(folder, grasps) as log:
        for attempt in attempts:
            log.append(attempt)
    return folder / "attempts.jsonl"


def test_appended_attempts_are_read_back(tmp_path):
    path = write(tmp_path)
    assert read_attempts(tmp_path, GRASPS) == list(ALL)
    row = {"object_id": "mug", "number": 1, "outcome": "no_plan", "accepted": False, "ended_s": 13.0}
    assert json.loads(path.read_text().splitlines()[1]) == {**row, "reason": "the object is wider than the stroke"}


def test_an_ungraspable_object_is_in_the_log_and_the_table_without_attempts(tmp_path):
    ball = LoggedAttempt("ball", 0, "ungraspable", False, 31.0, reason="wider than the gripper opens")
    write(tmp_path, (*ALL, ball))
    tallies = list(tally(read_attempts(tmp_path, GRASPS)).values())
    assert (tallies[2].attempts, tallies[2].skipped) == (0, "wider than the gripper opens")
    assert [each.skipped for each in tallies[:2]] == [None, None]
    assert acceptance_table(tallies, grasps_target=2).splitlines()[1:] == [
        "mug               1   3  gave up",
        "cup, blue         1   1  gave up",
        "ball              0   0  skipped: wider than the gripper opens",
    ]


def test_a_log_is_continued_and_an_incomplete_last_line_is_ignored_wherever_it_was_cut(tmp_path):
    path = write(tmp_path)
    whole = path.read_bytes()
    last = whole.rindex(b"\n", 0, -1) + 1
    for end in range(last, len(whole)):
        path.write_bytes(whole[:end])
        lacks_newline = end == len(whole) - 1  # this line is complete
        assert read_attempts(tmp_path, GRASPS) == list(ALL if lacks_newline else ALL[:3])
        with AttemptLog(tmp_path, GRASPS) as log:
            for attempt in ALL[len(log.attempts) :]:
                log.append(attempt)
        assert path.read_bytes() == whole


def test_a_last_line_whose_grasp_was_never_appended_is_ignored(tmp_path):
    path = write(tmp_path)
    whole = path.read_bytes()
    assert read_attempts(tmp_path, GRASPS - {"cup-0000"}) == list(ALL[:3])
    with AttemptLog(tmp_path, GRASPS - {"cup-0000"}):
        pass
    assert path.read_bytes() == whole[: whole.rindex(b"\n", 0, -1) + 1]


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"\xff",
        b'{"object_id": "mug"}',
        b'{"object_id": "mug", "number": 0, "outcome": "lost", "accepted": true, "ended_s": 1.0}',
        b'{"object_id": "mug", "number": 0, "outcome": "held", "accepted": true, "ended_s": 1.0, "grasp_id": []}',
        b'{"object_id": "mug", "number": 0, "outcome": "held", "accepted": true, "ended_s": 1.0, "colour": 3}',
        b'{"object_id": "mug", "number": 1, "outcome": "held", "accepted": true, "ended_s": 1.0}',
    ],
)
def test_a_damaged_line_is_named(tmp_path, line):
    path = write(tmp_path)
    path.write_bytes(line + b"\n" + path.read_bytes())
    with pytest.raises(RecordingError, match=r"attempts\.jsonl, line 1: "):
        read_attempts(tmp_path, GRASPS)


def test_an_earlier_line_without_its_grasp_and_a_repeated_attempt_are_damage(tmp_path):
    path = write(tmp_path)
    with pytest.raises(RecordingError, match=r"attempts\.jsonl, line 1: its grasp mug-0000 is not in the recording"):
        read_attempts(tmp_path, GRASPS - {"mug-0000"})
    path.write_bytes(path.read_bytes() + path.read_bytes().splitlines(keepends=True)[1])
    with pytest.raises(RecordingError, match="line 5: attempts must be numbered in order"):
        read_attempts(tmp_path, GRASPS)
