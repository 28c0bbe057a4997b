"""A plain USB camera over the table: colour only, so the pose of a grasp must come from elsewhere."""

import time
from typing import Any

import numpy as np
import numpy.typing as npt

from robot.devices import Camera, Clock
from robot.drivers.video.frames import ReaderSettings
from robot.drivers.video.opencv_stream import LEAVE, CaptureSettings, reader_maker
from robot.drivers.video.rectify import in_rgb
from robot.readings import RGBD


class UvcCamera(Camera):
    """A USB camera by its stable name; settings as in CaptureSettings and ReaderSettings, automatics on."""

    has_depth = False

    def __init__(
        self,
        *,
        device: str,
        extrinsics: npt.ArrayLike,
        width: int = 0,
        height: int = 0,
        fps: float = 0.0,
        fourcc: str = "",
        auto_exposure: bool = True,
        exposure_ms: float = LEAVE,
        auto_white_balance: bool = True,
        white_balance_k: float = LEAVE,
        gain: float = LEAVE,
        upside_down: bool = False,
        warmup_s: float = 1.0,
        timeout_s: float = 3.0,
        frozen_s: float = 2.0,
        allow_index: bool = False,
        clock: Clock = time.monotonic,
    ) -> None:
        """Raises RobotConfigError for a setting out of range; touches no device."""
        super().__init__("usb camera", extrinsics, clock=clock)
        self.upside_down = upside_down
        asked = CaptureSettings(
            width, height, fps, fourcc, auto_exposure, exposure_ms, auto_white_balance, white_balance_k, gain
        )
        reading = ReaderSettings(keep=1, warmup_s=warmup_s, timeout_s=timeout_s, frozen_s=frozen_s)
        self._make_reader = reader_maker(self, device, asked, reading, allow_index=allow_index)
        self._reader = self._make_reader()

    def _connect(self) -> None:
        self._reader = self._make_reader()
        self._reader.start()

    def _close(self) -> None:
        self._reader.close()

    def _settings(self) -> dict[str, Any]:
        return dict(self._reader.camera)

    def _recover(self) -> None:
        self._reader.recover()

    def _read(self, depth: bool) -> RGBD:
        frame = self._reader.newest()
        colour = in_rgb(frame.pixels)
        return RGBD(np.ascontiguousarray(colour[::-1, ::-1]) if self.upside_down else colour, None, None, frame.time_s)
