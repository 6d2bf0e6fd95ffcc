"""Dark round markers, located to a few hundredths of a pixel.

The response is a box mean over one lattice cell minus a Gaussian of the marker's size: a matched filter whose
background always holds exactly one marker, so illumination, exposure and the neighbours cancel. The peak of the
response is the maximum-likelihood position under white noise; a paraboloid over 3 x 3 pixels locates it.
"""

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from service.perception.markers.field import FloatArray


def _paraboloid(side: int) -> tuple[NDArray[np.intp], FloatArray]:
    """Pixel offsets [side^2, 2] of a window and the least-squares operator [6, side^2] of a paraboloid over them."""
    reach = range(-(side // 2), side // 2 + 1)
    offsets = np.array([(dx, dy) for dy in reach for dx in reach], np.intp)
    terms = np.array([(1, dx, dy, dx * dx, dx * dy, dy * dy) for dx, dy in offsets.tolist()], np.float64)
    return offsets, np.linalg.pinv(terms).astype(np.float32)


_OFFSETS, _OPERATOR = _paraboloid(3)
SIGMA_PER_DIAMETER = 0.32  # flat optimum between 0.26 and 0.4 for a disk seen through a lens of 0.35 px


@dataclass(frozen=True, slots=True)
class Candidates:
    """Marker-like spots, strongest first: ``xy_px`` float32 [n, 2] (u, v), ``strength`` float32 [n] in grey levels.

    ``tightness`` float32 [n] is the response's fall-off along its flattest direction, as a share of its height: small
    where a spot is smeared, stretched by the gel under it, or merged from two markers.
    """

    xy_px: FloatArray
    strength: FloatArray
    tightness: FloatArray

    def only(self, keep: NDArray[np.bool_] | NDArray[np.intp]) -> Self:
        return type(self)(self.xy_px[keep], self.strength[keep], self.tightness[keep])


@dataclass(frozen=True, slots=True)
class MarkerDetector:
    """Finds markers of ``diameter_px`` on a grid of about ``pitch_px``; ``shrink`` reduces the image first."""

    diameter_px: float
    pitch_px: float
    shrink: int = 1

    def response(self, image: NDArray[np.uint8]) -> FloatArray:
        """Matched-filter response float32 [height / shrink, width / shrink], grey levels, positive on dark markers."""
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
        if self.shrink > 1:
            size = (grey.shape[1] // self.shrink, grey.shape[0] // self.shrink)
            grey = cv2.resize(
                grey[: size[1] * self.shrink, : size[0] * self.shrink], size, interpolation=cv2.INTER_AREA
            )
        sigma = SIGMA_PER_DIAMETER * self.diameter_px / self.shrink
        cell = 2 * round(self.pitch_px / self.shrink / 2) + 1
        taps = 2 * int(np.ceil(2.5 * sigma)) + 1
        weights = cv2.getGaussianKernel(taps, sigma, cv2.CV_32F)
        peak = cv2.sepFilter2D(grey, cv2.CV_32F, weights, weights)
        around = cv2.boxFilter(grey, cv2.CV_32F, (cell, cell))
        return np.asarray(cv2.subtract(around, peak), np.float32)

    def detect(self, image: NDArray[np.uint8], threshold: float) -> Candidates:
        """Local maxima of the response above ``threshold`` grey levels, in pixels of the full image."""
        response = self.response(image)
        reach = max(1, round(0.3 * self.pitch_px / self.shrink))
        tallest = cv2.dilate(response, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
        peaks = (response >= tallest) & (response > threshold)
        peaks[:1] = peaks[-1:] = False
        peaks[:, :1] = peaks[:, -1:] = False
        flat = np.flatnonzero(peaks)
        strength = response.ravel()[flat]
        flat = flat[np.argsort(-strength, kind="stable")]
        return self._refine(response, flat)

    def _refine(self, response: FloatArray, flat: NDArray[np.intp]) -> Candidates:
        width = response.shape[1]
        values = response.ravel()[flat[:, None] + _OFFSETS[:, 1] * width + _OFFSETS[:, 0]]
        _, gx, gy, xx, xy, yy = (values @ _OPERATOR.T).T
        determinant = 4 * xx * yy - xy * xy
        sound = determinant > 1e-9
        safe = np.where(sound, determinant, 1)
        shift = np.stack([xy * gy - 2 * yy * gx, xy * gx - 2 * xx * gy], 1) / safe[:, None]
        shift = np.clip(np.where(sound[:, None], shift, 0), -1, 1)
        centre = np.stack([flat % width, flat // width], 1) + shift
        # With INTER_AREA the centre of small pixel i is that of the block of `shrink` pixels it averages.
        full = (centre + 0.5) * self.shrink - 0.5
        strength = values[:, len(_OFFSETS) // 2]
        flattest = -(xx + yy) - np.hypot(xx - yy, xy)
        return Candidates(full.astype(np.float32), strength, flattest / strength)
