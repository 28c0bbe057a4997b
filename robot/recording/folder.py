"""The recording: a folder of grasps, appended one at a time and read by training.

    recording.json    schema_version, source, sensor, rig, units, seed, software_version, background, gels (for each
                      pair used: thickness_mm, modulus_mpa, poisson by finger, or "unknown"), and further keys
    metadata.jsonl    one line with a JSON object for each grasp
    images/           PNG or JPEG files; several grasps may share one
    attempts.jsonl    only if a rig collected it: all attempts (robot.recording.attempt_log)

A line contains the fields of `RecordedGrasp` without the values that were not recorded. Images are paths relative to
the folder: photo_file_name (absent in a recording of touches only), depth_file_name and for each finger (a, b, ...)
touch_a_file_name, touch_a_before_file_name (no contact) and touch_a_after_file_name. Hugging Face datasets
("imagefolder") opens the folder as it is.

A line is written after its images are on disk, so a crash leaves complete grasps; an incomplete last line is dropped.
"""

import contextlib
import io
import json
import os
import re
from collections.abc import Iterator, Mapping, Set
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from _touch_retrieval.files import sync, write_atomically
from robot.errors import RecordingError
from robot.gel_settings import UNKNOWN
from robot.recording.grasp import RecordedGrasp, check_name
from robot.storage import (
    SYNC_THREADS,
    ImageSource,
    LineFile,
    complete_lines,
    file_content,
    parse_object,
    read_content,
    read_json_object,
    storage_errors,
    write_files,
)

SCHEMA_VERSION = 1
INFO_FILE = "recording.json"
METADATA_FILE = "metadata.jsonl"
IMAGES_FOLDER = "images"
UNITS = {
    "force_n": "newton",
    "opening_mm": "millimetre between the fingers",
    "pose": "x, y, z in millimetre and yaw in radian of the gripper, in the rig's frame",
    "time_s": "second since the recording began",
    "touch_skew_s": "second between the fingers' images",
    "depth": "millimetre, uint16, 0 where unknown",
}
GRASP_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")


@dataclass(frozen=True)
class SharedImage:
    """An image of several grasps, such as one no-contact frame for all, stored once.

    Attributes:
        name: Name with the characters of a grasp id; a later image of the same name is ignored.
        source: The image.

    >>> from pathlib import Path
    >>> photo = robot.SharedImage("mug-front", Path("catalog/mug/1.jpg"))
    >>> with robot.RecordingWriter("shared", {"source": "bench 3", "sensor": "DIGIT"}) as writer:
    ...     one = writer.append("000001", "mug", {"photo": photo, "touch_a": Path("a.png")})
    ...     two = writer.append("000002", "mug", {"photo": photo, "touch_a": Path("a2.png")})
    >>> one.photo == two.photo
    True
    """

    name: str
    source: ImageSource


@dataclass(frozen=True)
class Recording:
    """A recording as read.

    Attributes:
        folder: Its folder.
        info: Content of recording.json.
        grasps: Its grasps, in order.
        notes: Remarks for the user.

    >>> recording = robot.read_recording("recording")
    >>> len({grasp.object_id for grasp in recording.grasps})
    2
    >>> (recording.folder / recording.grasps[0].photo).is_file()
    True
    """

    folder: Path
    info: dict[str, Any]
    grasps: tuple[RecordedGrasp, ...]
    notes: tuple[str, ...] = ()


def read_recording(folder: str | Path) -> Recording:
    """Read and check a recording without opening its images.

    An incomplete last line, left by a crash, is dropped with a note.

    Raises:
        RecordingError: The recording is invalid; the message names the file and the line.

    >>> [grasp.object_id for grasp in robot.read_recording("recording").grasps]
    ['mug', 'mug', 'tin', 'tin']
    >>> robot.read_recording("catalog")
    Traceback (most recent call last):
    robot.errors.RecordingError: catalog must be a recording, but has no recording.json; ...
    """
    root = Path(folder)
    info = read_info(root)
    path = root / METADATA_FILE
    data = read_content(path, RecordingError)
    lines = complete_lines(data)
    dropped = len(data) - len(lines)
    notes = (f"{path}: dropped an incomplete last line ({dropped} bytes), left by a crash",) if dropped > 0 else ()
    return Recording(root, info, tuple(_grasps(path, lines)), notes)


def _grasps(path: Path, lines: bytes) -> Iterator[RecordedGrasp]:
    grasp_ids: set[str] = set()
    for number, line in enumerate(io.BytesIO(lines), start=1):
        if not line.strip():
            continue
        try:
            grasp = RecordedGrasp.from_row(parse_object(line, RecordingError))
            if grasp.grasp_id in grasp_ids:
                raise RecordingError(f"grasp_id must be unique, got {grasp.grasp_id!r} twice")
        except RecordingError as error:
            raise RecordingError(f"{path}, line {number}: {error}") from error
        grasp_ids.add(grasp.grasp_id)
        yield grasp


def read_info(root: Path) -> dict[str, Any]:
    """Read and check recording.json only; raise RecordingError if it is missing or invalid."""
    path = root / INFO_FILE
    if not os.path.exists(path):  # also False for a name that the file system cannot store
        raise RecordingError(f"{root} must be a recording, but has no {INFO_FILE}; `retrieve import` writes recordings")
    return _checked_info(read_json_object(path, RecordingError), path)


def _checked_info(info: dict[str, Any], path: str | Path = INFO_FILE) -> dict[str, Any]:
    if (version := info.get("schema_version")) != SCHEMA_VERSION:
        raise RecordingError(f"{path}: schema_version must be {SCHEMA_VERSION}, got {version!r}")
    for key in ("source", "sensor"):
        check_name(f"{path}: {key}", info.get(key))
    return info


class RecordingWriter(contextlib.AbstractContextManager["RecordingWriter"]):
    """Appends grasps to a recording that it creates or continues; one writer at a time.

    An existing recording is continued if its source, sensor, units and background agree; its recording.json is not
    changed. An incomplete last line is removed.

    Args:
        folder: The recording.
        info: Content of recording.json: source, sensor and any other keys.

    Raises:
        RecordingError: The input is invalid, or the folder contains other files.
        StorageError: The disk refused a write, or another process is writing the recording. Grasps appended before
            are complete.

    >>> from pathlib import Path
    >>> photo, a, b = (Path(name) for name in ("catalog/mug/1.jpg", "a.png", "b.png"))
    >>> with robot.RecordingWriter("mine", {"source": "bench 3", "sensor": "GelSight Mini"}) as writer:
    ...     grasp = writer.append("000001", "mug", {"photo": photo, "touch_a": a, "touch_b": b}, force_n=12.0)
    >>> len(robot.read_recording("mine").grasps), grasp.force_n
    (1, 12.0)
    """

    def __init__(self, folder: str | Path, info: Mapping[str, Any]) -> None:
        self.folder, self._threads = Path(folder), ThreadPoolExecutor(SYNC_THREADS)
        expected = full_info(info)
        _check_no_other_files(self.folder)
        with storage_errors(self.folder):
            (self.folder / IMAGES_FOLDER).mkdir(parents=True, exist_ok=True)
            self._lines = LineFile(self.folder / METADATA_FILE)
            try:
                self._start(expected)
            except BaseException:
                self._lines.close()
                raise

    def _start(self, expected: dict[str, Any]) -> None:
        """Create recording.json unless it exists, and cut an incomplete last line off metadata.jsonl."""
        for left in self.folder.glob(f".{INFO_FILE}.*.tmp"):  # by a killed writer; this one has locked the folder
            left.unlink()
        if not (self.folder / INFO_FILE).exists():
            self._write_info(expected)
        self.info = read_info(self.folder)
        for key in ("source", "sensor", "units", "background"):
            if (old := self.info.get(key)) != (new := expected.get(key)):
                raise RecordingError(f"{self.folder} was recorded with {key} {old!r}, not {new!r}; give another folder")
        lines = self._lines.read()
        self._grasp_ids = {grasp.grasp_id: None for grasp in _grasps(self.folder / METADATA_FILE, lines)}
        self._lines.keep(len(lines))

    @property
    def grasp_ids(self) -> Set[str]:
        """Ids of the grasps in the recording so far, in order."""
        return self._grasp_ids.keys()

    def append(
        self, grasp_id: str, object_id: str, images: Mapping[str, ImageSource | SharedImage], **fields: Any
    ) -> RecordedGrasp:
        """Append one grasp, first its images, then its line; both are on disk when this returns.

        Args:
            grasp_id: Unique id.
            object_id: The object.
            images: Images by column (photo, touch_a, touch_a_before, depth, ...).
            fields: Further fields of `RecordedGrasp`.

        Raises:
            RecordingError: An argument is invalid.
            StorageError: The disk refused a write.
        """
        _check_id("grasp_id", grasp_id)
        if grasp_id in self._grasp_ids:
            raise RecordingError(f"the recording already contains grasp {grasp_id}; see grasp_ids")
        contents: dict[str, bytes] = {}
        paths: dict[str, str] = {}
        for column, source in images.items():
            name = f"{grasp_id}_{column}"
            if isinstance(source, SharedImage):
                if stored := self.shared_path(source.name):
                    paths[f"{column}_file_name"] = stored
                    continue
                name, source = f"{source.name}_shared", source.source
            data, suffix = file_content(column, source)
            paths[f"{column}_file_name"] = path = f"{IMAGES_FOLDER}/{name}{suffix}"
            contents[path] = data
        plain = {key: np.asarray(value).tolist() for key, value in fields.items()}  # numbers of numpy, in a pose too
        row = {"grasp_id": grasp_id, "object_id": object_id, **plain, **paths}
        grasp = RecordedGrasp.from_row(row)
        if unknown := sorted({key for key in row if row[key] is not None} - grasp.to_row().keys()):
            raise RecordingError(f"unknown key {unknown[0]!r}; robot.recording.folder lists the known keys")
        with storage_errors(self.folder):
            write_files({self.folder / path: data for path, data in contents.items()}, self._threads)
            sync(self.folder / IMAGES_FOLDER)
            self._lines.append(json.dumps(grasp.to_row(), ensure_ascii=False).encode())
        self._grasp_ids[grasp_id] = None
        return grasp

    def shared_path(self, name: str) -> str | None:
        """Return the path of the shared image `name`; None if the recording does not contain it."""
        _check_id("the name of a shared image", name)
        paths = (f"{IMAGES_FOLDER}/{name}_shared{suffix}" for suffix in (".png", ".jpg"))
        return next((path for path in paths if (self.folder / path).is_file()), None)

    def update_info(self, **info: Any) -> None:
        """Add or replace entries of recording.json.

        Raises:
            RecordingError: An entry is not plain JSON.
            StorageError: The disk refused the write.
        """
        updated = full_info({**self.info, **info})
        if updated != self.info:
            with storage_errors(self.folder):
                self._write_info(updated)
            self.info = updated

    def _write_info(self, info: Mapping[str, Any]) -> None:
        write_atomically(self.folder / INFO_FILE, json.dumps(info, indent=2).encode() + b"\n")

    def close(self) -> None:
        """Close the file and release the folder's lock; a second call does nothing."""
        self._lines.close()
        self._threads.shutdown()

    def __exit__(self, *_: object) -> None:
        self.close()


def safe_name(*parts: str) -> str:
    """Return the parts as a grasp_id, joined by "-"; invalid characters are replaced and a digest is appended.

    >>> safe_name("mug", "01"), safe_name("my mug", "01")
    ('mug-01', 'my-mug-01-b68d33c2')
    """
    joined = "-".join(parts)
    if GRASP_ID.fullmatch(joined):
        return joined
    plain = re.sub(r"[^A-Za-z0-9._-]", "-", joined)[:100].lstrip("._-") or "grasp"
    # Names of unknown encoding and JSON escapes can contain surrogates.
    return f"{plain}-{sha256('/'.join(parts).encode(errors='surrogatepass')).hexdigest()[:8]}"


def _check_id(what: str, name: str) -> None:
    if not isinstance(name, str) or not GRASP_ID.fullmatch(name):
        raise RecordingError(
            f"{what} must have 1 to 128 characters: ASCII letters, digits, '.', '_' or '-'; the first must be a "
            f"letter or a digit; got {name!r}"
        )


def full_info(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return `info` with defaults, as JSON reads it back; raise RecordingError if it is invalid."""
    defaults = {
        "schema_version": SCHEMA_VERSION,
        "source": None,
        "sensor": None,
        "rig": None,
        "units": UNITS,
        "seed": None,
        "software_version": software_version(),
        "background": "none",
        "gels": UNKNOWN,
    }
    try:
        return _checked_info(json.loads(json.dumps({**defaults, **info}, allow_nan=False)))
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{INFO_FILE} must contain plain JSON: {error}") from error


def software_version() -> str:
    """Return the installed version of this project, or "unknown"."""
    from importlib.metadata import PackageNotFoundError, version

    with contextlib.suppress(PackageNotFoundError):
        return version("touch-retrieval")
    return "unknown"


def _check_no_other_files(folder: Path) -> None:
    """Raise RecordingError if a new recording would be mixed into a folder of other files."""
    if (folder / INFO_FILE).is_file() or not folder.exists():
        return
    if not folder.is_dir():
        raise RecordingError(f"a recording must be a folder, and {folder} is a file")
    with storage_errors(folder):
        names = {path.name for path in folder.iterdir() if not path.name.startswith(f".{INFO_FILE}.")}
        grasps = METADATA_FILE in names and (folder / METADATA_FILE).stat().st_size > 0
    if others := names - {METADATA_FILE, IMAGES_FOLDER}:
        raise RecordingError(f"{folder} contains other files, such as {min(others)}; give a new or an empty folder")
    if grasps:
        raise RecordingError(f"{folder} has a {METADATA_FILE} but no {INFO_FILE}; restore it or give a new folder")
