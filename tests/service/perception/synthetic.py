"""Analytic marker images and marker fields with known truth, for the perception tests."""

from collections.abc import Callable

import numpy as np

from service.perception.markers.field import MarkerField

FRAME_NS = 33_333_333


def grid(rows=20, cols=21, pitch=15.0, width=327, height=320, jitter=0.3, seed=0):
    """Marker centres [rows, cols, 2] centred in the image, with a fixed irregularity."""
    rng = np.random.default_rng(seed)
    u = (np.arange(cols) - (cols - 1) / 2) * pitch + (width - 1) / 2
    v = (np.arange(rows) - (rows - 1) / 2) * pitch + (height - 1) / 2
    return np.stack(np.meshgrid(u, v), -1) + rng.normal(0, jitter, (rows, cols, 2))


def draw(points, rng, width=327, height=320, diameter=5.0, contrast=90.0, noise=2.0, light=140.0):
    """BGR image of dark disks with soft rims (logistic, 0.35 px) at ``points`` [..., 2] on an uneven light."""
    v, u = np.mgrid[0:height, 0:width]
    image = light * (1 + 0.15 * (u / width - 0.5) - 0.2 * (v / height - 0.5))
    reach = int(diameter) + 3
    for x, y in np.asarray(points).reshape(-1, 2):
        if not (-reach < x < width + reach and -reach < y < height + reach):
            continue
        left, top = max(0, int(x) - reach), max(0, int(y) - reach)
        window = np.s_[top : max(0, int(y) + reach + 1), left : max(0, int(x) + reach + 1)]
        distance = np.hypot(u[window] - x, v[window] - y)
        image[window] -= contrast * light / 140 / (1 + np.exp(np.clip((distance - diameter / 2) / 0.35, -50, 50)))
    colours = np.stack([image * share for share in (0.9, 1.0, 1.05)], -1)
    return np.clip(np.round(colours + rng.normal(0, noise, (height, width, 1))), 0, 255).astype(np.uint8)


def twist(points, degrees, centre=(163.0, 159.5), shift=(0.0, 0.0)):
    """Points turned about ``centre`` (from u to v) and shifted."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    x = np.asarray(points) - centre
    return x @ np.array([[c, s], [-s, c]]) + centre + shift


def stretched(points, by_px):
    """Points pulled apart along a line in their middle, less with distance, as by an edge that presses into it."""
    across, along = points[..., 0] - 166.0, points[..., 1] - 160.0
    pushed = by_px * np.sign(across) * (1 - np.exp(-np.abs(across) / 14.0)) * np.exp(-np.abs(across) / 60.0)
    pushed *= np.exp(-np.square(along / 90.0) / 2)
    return points + np.stack([pushed, np.zeros_like(pushed)], -1)


def patch_fields(
    motion: Callable[[int, np.ndarray], np.ndarray],
    *,
    frames=20,
    hold_px=np.inf,
    noise_px=0.05,
    contact_known=False,
    elastic=True,
    half=(80.0, 60.0),
    centre=(150.0, 140.0),
    seed=0,
    rows=20,
    cols=21,
    pitch=15.0,
) -> tuple[list[MarkerField], list[float]]:
    """Fields of a pressed rectangular patch whose nodes stick up to ``hold_px`` times root pressure, and slip beyond.

    ``motion(k, rest)`` is the object's displacement [rows, cols, 2] at frame k. Also returns the true slipping share.
    """
    rng = np.random.default_rng(seed)
    rest = np.stack(np.meshgrid(np.arange(cols), np.arange(rows)), -1).astype(np.float64) * pitch
    rho = np.abs((rest - centre) / half).max(-1)
    inside = rho < 1
    limit = hold_px * np.sqrt(np.clip(1 - rho**2, 1e-9, None))
    fields, shares = [], []
    for k in range(frames):
        target = motion(k, rest)
        size = np.linalg.norm(target, axis=-1)
        held = np.where(size > limit, limit / np.maximum(size, 1e-9), 1)[..., None] * target
        outside = 0.6 * np.exp(-3 * np.clip(rho - 1, 0, None))[..., None] * target * elastic
        displacement = np.where(inside[..., None], held, outside) + rng.normal(0, noise_px, rest.shape)
        shares.append(float((inside & (size > limit)).sum() / inside.sum()))
        fields.append(
            MarkerField(
                rest.astype(np.float32),
                displacement.astype(np.float32),
                np.ones((rows, cols), np.bool_),
                inside if contact_known else None,
                pitch,
                k * FRAME_NS,
            )
        )
    return fields, shares


def rigid(shift=(0.0, 0.0), degrees=0.0, centre=(150.0, 140.0)):
    """A motion for :func:`patch_fields`: per frame, turn by ``degrees`` about ``centre`` and move by ``shift`` px."""
    return lambda k, rest: twist(rest, degrees * k, centre, (shift[0] * k, shift[1] * k)) - rest


def pressed(motion):
    """The motion of markers that a grip has spread."""

    def spread(k, rest):
        from_middle = rest - rest.mean((0, 1))
        return 0.01 * from_middle + 0.02 * np.abs(from_middle)[..., ::-1] + motion(k, rest)

    return spread


def hard_image(case, rng):
    """A picture without usable content, or with too much of it, of the grid that :func:`grid` makes by default."""
    rest = grid()
    if case == "noise":
        return rng.integers(0, 256, (320, 327, 3), dtype=np.uint8)
    if case in ("black", "white"):
        return np.full((320, 327, 3), 0 if case == "black" else 255, np.uint8)
    if case == "saturated":
        return np.clip(draw(rest, rng).astype(int) * 3, 0, 255).astype(np.uint8)
    if case == "covered":
        image = draw(rest, rng)
        image[:, 160:] = 30
        return image
    points = {
        "twist": twist(rest, 45),
        "twist 90": twist(rest, 90),
        "jump 1.6 pitch": rest + 24,
        "merged": merged(rest),
        "line": rest[:1],
        "three": rest[0, :3],
        "none": rest[:0],
        "scattered": rng.uniform(10, 310, (400, 2)),
    }
    return draw(points[case], rng)


def merged(points):
    """Two neighbours at a time pushed onto each other in a corner of the grid."""
    moved = points.copy()
    moved[4:10, 4:10:2] = moved[4:10, 5:11:2]
    return moved
