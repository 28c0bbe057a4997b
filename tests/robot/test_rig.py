"""A rig connects all devices or none, always closes them, and is built from its name or a TOML file."""

import pytest

from robot.errors import DeviceError, RobotConfigError, UnknownName
from robot.rig import Rig, load_rig
from robot.sight.cylinder import CylinderFit
from tests.fake_rig import FakeRig

ORDER = ["arm", "gripper", "gel a", "gel b", "camera"]


def events(rig, what):
    return [call.removesuffix(f".{what}") for call in rig.shared.calls if call.endswith(f".{what}")]


def test_all_devices_are_connected_in_order_and_closed_once_in_reverse():
    rig = FakeRig()
    rig.close()
    with rig:
        assert events(rig, "connect") == ORDER
        assert all(device.is_connected for device in rig.devices)
        assert rig.settings()["fake gripper"] == {"stroke_mm": 110.0}  # read back from the device
        assert set(rig.settings()) == {device.name for device in rig.devices}
    rig.close()
    assert events(rig, "close") == ORDER[::-1]


@pytest.mark.parametrize("number", range(len(ORDER)))
def test_if_one_device_fails_none_stays_connected(number):
    rig = FakeRig(faults={f"{ORDER[number]}.connect": {1}})
    with pytest.raises(DeviceError, match="fails on purpose"):
        rig.connect()
    assert not any(device.is_connected for device in rig.devices)
    assert events(rig, "close") == ORDER[: number + 1][::-1]  # the one that failed cleans up after itself
    rig.connect()
    assert all(device.is_connected for device in rig.devices)


def test_closing_continues_when_one_device_fails():
    rig = FakeRig(faults={"gel b.close": {1}, "arm.close": {1}})
    rig.connect()
    with pytest.raises(DeviceError, match=r"\.close fails on purpose"):
        rig.close()
    assert not any(device.is_connected for device in rig.devices)
    assert events(rig, "close") == ORDER[::-1]
    rig.close()


def test_a_failure_to_close_does_not_hide_the_first_error():
    with pytest.raises(ZeroDivisionError) as caught, FakeRig(faults={"arm.close": {1}}):
        _ = 1 / 0
    assert "while the rig was closed: the fake arm.close fails on purpose" in caught.value.__notes__[0]


def test_a_prompt_appears_when_the_object_changes_or_has_a_given_position_and_needs_a_person():
    requests = []
    fake = FakeRig()
    rig = Rig(fake.arm, fake.gripper, fake.sensors, fake.camera, info={}, ask=requests.append)
    for object_id, number in [("mug", 0), ("mug", 1), ("cup", 0), ("mug", 2)]:
        rig.prepare(object_id, number)
    assert [text.split()[1] for text in requests] == ["mug", "cup", "mug"]
    rig.object_fit = CylinderFit(5.0, -2.5, 100.0, 30.0, "given", (30.0, 30.0))  # the attempt may have moved it
    for number in range(2):
        rig.prepare("mug", number)
    assert requests[3:] == ["Put mug at x 5, y -2.5 mm, remove all other objects, then press Enter."] * 2
    assert rig.object_ids(2) == ["object-0001", "object-0002"]

    def nobody(text):
        raise EOFError

    rig.ask = nobody
    with pytest.raises(RobotConfigError, match="run it in a terminal"):
        rig.prepare("cup", 0)


def test_a_rig_is_built_by_its_name_and_its_info_rebuilds_it():
    rig = load_rig("tests.fake_rig:FakeRig", seed=7, fingers=["a"])
    assert isinstance(rig, FakeRig)
    assert rig.shared.seed == 7
    assert list(rig.sensors) == ["a"]
    assert rig.info["rig_settings"] == {"fingers": ["a"]}
    assert load_rig(rig.info["rig"], seed=7, **rig.info["rig_settings"]).info == rig.info
    assert not rig.arm.is_connected


def test_a_rig_is_built_from_a_toml_file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('rig = "tests.fake_rig:FakeRig"\nfingers = ["b"]\n')
    assert list(load_rig(str(path), seed=1).sensors) == ["b"]
    assert list(load_rig(str(path), seed=1, fingers=["a"]).sensors) == ["a"]  # the argument overrides the file


BAD_FILES = {
    None: "rig.toml cannot be read",
    "rig = ": "is not TOML",
    "[fake]": "must name its rig",
    'rig = "none"': "must be one of real, sim; got 'none'",
    'rig = "tests.fake_rig:FakeRig"\ncolour = 3': "has no setting 'colour'; known settings: faults, fingers",
}


@pytest.mark.parametrize("text", BAD_FILES)
def test_a_wrong_file_raises_with_the_reason(tmp_path, text):
    path = tmp_path / "rig.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises((RobotConfigError, UnknownName), match=BAD_FILES[text]):
        load_rig(str(path), seed=0)


@pytest.mark.parametrize("seed", [-1, 1.5, None, "0"])
def test_a_seed_must_be_a_whole_number_from_0(seed):
    with pytest.raises(RobotConfigError, match=r"^seed must be a whole number"):
        load_rig("sim", seed=seed)
