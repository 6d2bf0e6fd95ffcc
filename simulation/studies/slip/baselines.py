"""Trackers and a slip rule of others, as baselines for the report: Lucas-Kanade, nearest blob, and the 2019 rule."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from service.perception.markers.detect import MarkerDetector
from service.perception.markers.field import MarkerField, empty_field
from service.perception.markers.lattice import Lattice, find_lattice

Image = NDArray[np.uint8]


class _FromFirstFrame:
    """Finds the grid in the first frame, then lets the subclass move the points."""

    def __init__(self) -> None:
        self.lattice: Lattice | None = None
        self.xy = np.zeros((0, 2), np.float32)
        self.valid = np.zeros(0, np.bool_)

    def update(self, image: Image, captured_ns: int) -> MarkerField:
        """One rectified frame in, the marker field out."""
        if self.lattice is None:
            self.lattice = find_lattice(image)
            if self.lattice is None:
                return empty_field(captured_ns, "no_grid", "no grid")
            self.xy = self.lattice.xy_px.reshape(-1, 2).copy()
            self.valid = self.lattice.detected.reshape(-1).copy()
        self.follow(image)
        rest = self.lattice.xy_px
        moved = self.xy.reshape(rest.shape) - rest
        valid = self.valid.reshape(rest.shape[:2]).copy()
        return MarkerField(rest, moved.astype(np.float32), valid, None, self.lattice.pitch_px, captured_ns)

    def follow(self, image: Image) -> None:
        """Move ``xy`` and ``valid`` to the new image."""
        raise NotImplementedError


class LucasKanade(_FromFirstFrame):
    """Pyramidal Lucas-Kanade from frame to frame on the grey image."""

    def __init__(self, window_px: int, levels: int) -> None:
        super().__init__()
        self.window_px, self.levels = window_px, levels
        self.grey: Image | None = None

    def follow(self, image: Image) -> None:
        """One step of optical flow."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        if self.grey is not None:
            size = (self.window_px, self.window_px)
            start = np.ascontiguousarray(self.xy[:, None])
            moved, status, _ = cv2.calcOpticalFlowPyrLK(
                self.grey, grey, start, start.copy(), winSize=size, maxLevel=self.levels
            )
            good = np.asarray(status)[:, 0] == 1
            self.xy = np.where(good[:, None], np.asarray(moved)[:, 0], self.xy).astype(np.float32)
            self.valid &= good
        self.grey = grey


class NearestBlob(_FromFirstFrame):
    """Spots of the same detector, each marker to the nearest spot within 0.46 pitch, no topology."""

    def follow(self, image: Image) -> None:
        """One step of nearest neighbours."""
        assert self.lattice is not None
        pitch = self.lattice.pitch_px
        spots = MarkerDetector(self.lattice.diameter_px, pitch).detect(image, 0.3 * self.lattice.strength)
        if len(spots.strength) == 0:
            self.valid[:] = False
            return
        squared = np.square(self.xy[:, None] - spots.xy_px[None]).sum(-1)
        nearest = squared.argmin(1)
        close = squared[np.arange(len(nearest)), nearest] < (0.46 * pitch) ** 2
        self.xy = np.where(close[:, None], spots.xy_px[nearest], self.xy)
        self.valid = close


def plain_residual(field: MarkerField, reference: MarkerField) -> NDArray[np.float64]:
    """Deviation in px of each valid marker from one least-squares rigid motion of all of them, largest first."""
    may = (field.valid & reference.valid).reshape(-1)
    x = (reference.rest_px + reference.displacement_px).reshape(-1, 2)[may].astype(np.float64)
    y = (field.rest_px + field.displacement_px).reshape(-1, 2)[may].astype(np.float64)
    if len(x) < 4:
        return np.zeros(1)
    a, b = x - x.mean(0), y - y.mean(0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(angle), np.sin(angle)
    off = np.linalg.norm(b - a @ np.array([[c, s], [-s, c]]), axis=1)
    return np.asarray(np.sort(off)[::-1])


def rule_2019(field: MarkerField, reference: MarkerField) -> bool:
    """Dong et al. 2019: slip if more than 7 markers deviate by more than 0.30 pitch from the rigid prediction."""
    off = plain_residual(field, reference)
    return bool(off.size > 7 and off[7] > 0.30 * field.pitch_px)
