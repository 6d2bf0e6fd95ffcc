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
    worst = max(report["models"], key=lambda row: row["cpu_p50_ms"])
    return page(
        f"""
        # What a decision costs

        The slowest of the {len(report["models"])} networks takes {worst["cpu_p50_ms"]:.2f} ms of CPU per call
        (`{worst["file"]}`, median).

        Measured by `make bench` on {report["cpu"]}, at commit `{report["commit"][:12]}`, with one thread, golden inputs
        and without the warm-up. Quote the CPU time: on a shared machine, wall time also measures the neighbours.
        """,
        table(
            report["models"],
            ("model", lambda row: f"`{row['file']}`"),
            ("CPU ms: median", "cpu_p50_ms", ".2f"),
            ("99 %", "cpu_p99_ms", ".2f"),
            ("wall ms: median", "p50_ms", ".2f"),
            ("99 %", "p99_ms", ".2f"),
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

            A build pays if it takes less than {100 * PAYS:.0f} % of the CPU time of fp32. ONNX Runtime quantises the
            networks that read pictures; only their convolutions are large enough. Both step models alternate with fp32.
            Commands are compared on {decided}, and count as the same within 0.1 mm and 0.1 deg.
            """
        yield table(
            rows,
            ("weights", "precision"),
            ("CPU ms per step", lambda row: row.get("cpu_p50_ms"), ".2f"),
            ("files MB", lambda row: row.get("size_mb"), ".2f"),
            ("same command", _same, ".0%"),
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

            Two fp32 AlexNet-LSTM networks, {weights}, take {paper["passes_cpu_ms"]:.0f} ms of CPU time for eight frame
            pairs. The table gives the time of each released folder after the last frame as a share of that, with
            quartiles. The calls alternate on one thread. The bound is 1/{1 / RELEASED_SHARE:.0f}.

            The time of a network that reads markers starts at the markers, because slip detection tracks them anyway;
            the [slip report](slip_report.md) has that cost per finger. The time of a network that reads pictures starts
            at the pictures.
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
