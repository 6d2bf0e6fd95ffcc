"""docs/benchmark.md from benchmark.json."""

from collections.abc import Iterator
from typing import Any

from export.bench.paper import RELEASED_SHARE
from reporting.page import page
from reporting.statistics import wilson
from reporting.table import Table, table

NAME = "benchmark"
PAYS = 0.9
"""A build that takes more than this share of the processor time of fp32 does not pay."""
Row = dict[str, Any]


def benchmark_page(report: Row) -> str:
    """The whole of docs/benchmark.md from benchmark.json."""
    return page(
        f"""
        # What a decision costs

        Written by `make bench` on {report["cpu"]}, at commit `{report["commit"][:12]}`; one thread, golden inputs,
        warm-up excluded. CPU is processor time, which is what to quote: wall time on a shared machine measures the
        neighbours. Load, first call and peak memory (beyond interpreter and libraries) are of a fresh process.
        """,
        table(
            report["models"],
            ("model", lambda row: f"`{row['file']}`"),
            ("CPU ms: median", "cpu_p50_ms", ".2f"),
            ("99 %", "cpu_p99_ms", ".2f"),
            ("wall ms: median", "p50_ms", ".2f"),
            ("99 %", "p99_ms", ".2f"),
            ("load ms", "fresh.load_ms", ".0f"),
            ("first ms", "fresh.first_ms", ".1f"),
            ("peak MB", "fresh.peak_mb", ".0f"),
            ("file MB", "size_mb", ".2f"),
        ),
        *_int8(report),
        *_paper(report.get("alexnet")),
    )


def _int8(report: Row) -> Iterator[str | Table]:
    if rows := report.get("int8"):
        decided = "recorded collisions" if report["int8_recorded"] else "golden frames, which decide nothing"
        yield f"""
            ## Does int8 pay?

            ONNX Runtime's quantiser on the networks that read pictures, the only ones with convolutions worth it; both
            step models in turn with fp32. Commands are compared on {decided}: the same within 0.1 mm and 0.1 deg.
            """
        yield table(
            rows,
            ("weights", "precision"),
            ("CPU ms a step", lambda row: row.get("cpu_p50_ms"), ".2f"),
            ("files MB", lambda row: row.get("size_mb"), ".2f"),
            ("the same command", _same, ".0%"),
            ("verdict", lambda row: _worth(row, rows[0])),
        )


def _same(row: Row) -> Any:
    return wilson(row["same_commands"], row["decisions"]) if "decisions" in row else None


def _worth(row: Row, exact: Row) -> str:
    if "refused" in row:
        return f"refused: {row['refused']}"
    if row is exact:
        return "shipped"
    return "pays" if row["cpu_p50_ms"] < PAYS * exact["cpu_p50_ms"] else "does not pay"


def _paper(paper: Row | None) -> Iterator[str | Table]:
    if paper:
        weights = "trained by `python -m training recipe`" if paper["trained"] else "of random weights (speed only)"
        yield f"""
            ## Against the paper's networks

            Two fp32 AlexNet-LSTM networks, {weights}, take {paper["passes_cpu_ms"]:.0f} ms of processor time over eight
            frame pairs. What a released folder takes after the last frame is given as a share of that, called in turn
            on one thread, with quartiles; the bound is 1/{1 / RELEASED_SHARE:.0f}. A network that reads markers is
            measured from the markers on: they are tracked for slip whatever decides, at the cost a finger that the
            [slip report](slip_report.md) has. One that reads pictures starts there.
            """
        yield table(
            paper["rows"],
            ("released", lambda row: f"`{row['folder']}`"),
            ("CPU ms", "cpu_p50_ms", ".2f"),
            ("share of two fp32 passes", lambda row: _fraction(*row["ratio"])),
            ("bound", lambda row: "holds" if row["ratio"][0] <= RELEASED_SHARE else "does not hold"),
        )


def _fraction(middle: float, low: float, high: float) -> str:
    return f"1/{1 / middle:.0f} (1/{1 / high:.0f} .. 1/{1 / low:.0f})"
