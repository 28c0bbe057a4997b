"""Calibration points in other units than mm, or few points measured often, are refused, and nothing is written."""

import csv

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from retrieval.commands.main import main
from robot.errors import RobotConfigError
from robot.sight.hand_eye import COLUMNS, fit_hand_eye, load_hand_eye

RNG = np.random.default_rng(0)
CAMERA = np.add(RNG.uniform(-150, 150, (12, 3)), [0, 0, 600])
TURN = Rotation.from_euler("xyz", [170, 10, 30], degrees=True)


def in_rig(camera):
    return np.add(TURN.apply(camera), [400, 20, 700]) + RNG.normal(0, 1, camera.shape)


def check(folder, get):
    capsys, out, table = get("capsys"), folder / "hand_eye.json", folder / "points.csv"
    rig, three = in_rig(CAMERA), np.repeat(CAMERA[:3], 4, axis=0)
    near = three + RNG.normal(0, 1, three.shape)
    units = {"metres": 1e-3, "centimetres": 0.1, "inches": 1 / 25.4}.values()
    scaled = [(a, b) for unit in units for a, b in ((unit, unit), (unit, 1), (1, unit))]
    refused = [(CAMERA * a, rig * b, "must be in mm") for a, b in scaled]
    copied = [(three, in_rig(CAMERA[:3]).repeat(4, axis=0)), (three, in_rig(three)), (near, in_rig(near))]
    refused += [(*points, "at least 4 different points, got 3") for points in copied]
    for camera, other, message in refused:
        with table.open("w", newline="") as file:
            csv.writer(file).writerows([COLUMNS, *np.hstack([camera, other])])
        assert main(["rig", "calibrate", str(table), "--out", str(out)]) == 2
        assert message in " ".join(capsys.readouterr().err.split())
        assert not out.exists()
    fit_hand_eye(CAMERA, rig).save(out)
    load_hand_eye(out)
    fit = fit_hand_eye(CAMERA, rig)  # as another program writes it
    fit.rigid[:3, 3] /= 1000
    fit.save(out)
    with pytest.raises(RobotConfigError, match="translation must be in mm"):
        load_hand_eye(out)
