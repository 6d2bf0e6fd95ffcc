"""The page's sections on the hardware's limit: how far each model stays above it, and on what that is spent."""

from collections.abc import Callable
from typing import Any

from export.yardstick import SHARED

NEAR_LIMIT = 1.05
"""How near to the hardware's limit the shared step should be."""


def limits_section(
    peaks: dict[str, float], rows: list[dict[str, Any]], name: Callable[[dict[str, Any]], str]
) -> list[str]:
    """Every model against both limits of :mod:`export.limits`."""
    lines = [
        "## Against the hardware's limit",
        "",
        f"Probed in this run, one core: {peaks['fp32_gflops']:.0f} GFLOPS fp32, {peaks['int8_gops']:.0f} GOPS int8,",
        f"{peaks['read_gb_s']:.1f} GB/s read from a buffer as large as the largest model. Peak limit: for every layer",
        "its multiplications at that peak, or its bytes (weights, and the frames or activations that it reads and",
        "writes) at that rate, whichever is slower. The shape limit takes for a layer the plain matrix product of its",
        "own rows, depth and columns, run alone and warm by the same runtime: a convolution has to gather its patches",
        "besides, but for the runtime's direct fp32 ones, which can be below it. Pooling, gates and the runtime's own",
        "work come on top.",
        "",
        "| model | CPU p50 ms | peak limit ms | times it | shape limit ms | times it |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        limit, cpu_ms = row["limit"], row["single"]["cpu_p50_ms"]
        peak = f"{limit['limit_ms']:.3f} | {limit['ratio']:.2f}"
        shaped = f"{limit['shaped_ms']:.3f} | {limit['shaped_ratio']:.2f}"
        lines.append(f"| {name(row)} | {cpu_ms:.2f} | {peak} | {shaped} |")
    return [*lines, ""]


def missed(found: dict[str, Any]) -> list[str]:
    """How far the shared int8 step stays from the limits, and on what the rest is spent."""
    row = next(row for row in found["rows"] if row["what"] == SHARED)
    over, over_shaped = row["cpu_p50_ms"] / row["limit_ms"], row["cpu_p50_ms"] / row["shaped_ms"]
    peaks = found["peaks"]
    probed = f"{peaks['int8_gops']:.0f} GOPS int8, {peaks['read_gb_s']:.1f} GB/s from a buffer of its weights' size"
    if over_shaped <= NEAR_LIMIT:
        return [f"The step behind one backbone in int8 is within {NEAR_LIMIT} of its shape limit ({probed})."]
    spent = found["operators_ms"]
    share = sum(spent.values())
    costly = ", ".join(f"{name} {100 * ms / share:.0f} %" for name, ms in list(spent.items())[:8])
    convolutions, products = row["convolutions_ms"], row["shaped_ms"] - row["convolutions_ms"]
    return [
        f"Behind one backbone in int8 it misses {NEAR_LIMIT} of either limit ({probed}):",
        f"it takes {over:.2f} times the peak limit and {over_shaped:.2f} times the shape limit, of which",
        f"{convolutions:.2f} ms are convolutions as plain products and {products:.2f} ms other layers and LSTMs,",
        "which read their weights once. Resize and colour order of the difference image are one of these convolutions.",
        f"Of the profiler's wall clock it spends {costly}.",
        "What the kernels could still save: a convolution gathers its patches into rows before the product and",
        "rescales its sums to bytes after it (QLinearConv against its plain product; most in the first two, whose",
        "patches are of 30 and 33 bytes a row), and difference, cut and the order of the resized pixels are passes of",
        "their own over the picture. None of that is in the limit, and no setting of this runtime saves it.",
    ]
