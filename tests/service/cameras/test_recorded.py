"""Recordings of files: what their headers state, and what they hold."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.cameras.recorded import clip_images, stated_frames_n

FRAMES_N = 12
DURATION = b"\x44\x89\x88"  # of a Matroska file: its tag, and that 8 bytes follow


def written(clip: Path) -> Path:
    out = cv2.VideoWriter(str(clip), cv2.VideoWriter_fourcc(*"MJPG"), 25, (96, 80))
    for k in range(FRAMES_N):
        out.write(np.full((80, 96, 3), 20 * k, np.uint8))
    out.release()
    return clip


@pytest.mark.parametrize("name", ["slow.mkv", "slow.MKV", "slow.webm"])
def test_a_file_whose_rate_varies_is_not_said_to_lack_frames(tmp_path: Path, name: str):
    """Its pictures last twice as long as the nominal rate has it: OpenCV then counts 24."""
    clip = written(tmp_path / "slow.mkv")
    before, header, after = clip.read_bytes().partition(DURATION)
    assert header
    lasts = struct.pack(">d", 2 * struct.unpack(">d", after[:8])[0])
    (tmp_path / name).write_bytes(before + header + lasts + after[8:])
    assert len(list(clip_images(tmp_path / name))) == FRAMES_N
    assert stated_frames_n(tmp_path / name) == 0


def test_the_header_of_other_files_states_their_number_of_frames(tmp_path: Path):
    assert stated_frames_n(written(tmp_path / "clip.avi")) == FRAMES_N
