"""The benchmark as one page and one figure."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from export.bench.measure import NOISY, NOISY_SPREAD, STEADY
from reporting.figure import drawing
from reporting.page import page, publish
from reporting.statistics import number
from reporting.table import Table, table

NAME = "benchmark"
LEAST_FOR_P999 = 1000
"""Calls below which the slowest of a thousand was not among them."""
EQUAL = 1.05
"""A ratio of processor times beyond which one runtime is called slower than another."""
Row = dict[str, Any]


def noisy(row: Row) -> bool:
    """Whether a row's wall times say more of the neighbours than of the model."""
    return bool(row["noise"]["wall_spread"] > NOISY_SPREAD or row["single"]["crowding"] > NOISY)


def write(report: Row, docs: Path) -> str:
    """Write benchmark.md, .json and .png; returns the page."""
    draw(report, docs / f"{NAME}.png")
    return publish(docs, NAME, benchmark_page(report), report)


def benchmark_page(report: Row) -> str:
    """The whole of docs/benchmark.md from benchmark.json."""
    rows = report["models"]
    return page(
        f"""
        # What a decision costs

        Written by `make bench` on {report["cpu"]}; one thread, warm-up excluded, golden frames. Measured at commit
        `{report["commit"][:12]}`. CPU is processor time, which is what to quote. {_noise(rows)}

        ![Processor time of a call]({NAME}.png)

        ## One call
        """,
        _calls(rows),
        f"""
        Ratio: p99 over p50 of the calling thread's processor time on one core, at most {STEADY}; every call counts.
        Machine: the same of arithmetic that never changes and takes as long, called in turn: what the hypervisor and
        the neighbours do to anything that runs here. Times in ms; `first` and `peak` (beyond interpreter and libraries)
        are of a fresh process.

        ## Throughput and LoadGen

        MLPerf LoadGen as a library. Server: a third of the capacity offered at random, p99 of the answers. Right
        directions: what LoadGen logged in its accuracy mode on recorded collisions, in the same run.
        """,
        _throughput(rows),
        """
        ## Threads and spinning

        p50 ms (CPU ms of all threads). Spinning threads burn a core that the cameras need.
        """,
        _sweep(rows),
        *_peers(report.get("peers")),
        """
        ## Where the time goes

        Mean ms a call by operator (profiler's clock, wall time).
        """,
        "\n".join(f"- {_name(row)}: {_operators(row['operators_ms'])}" for row in rows),
        *_paper(report.get("alexnet")),
    )


def _noise(rows: list[Row]) -> str:
    worst = max(row["noise"]["wall_spread"] for row in rows)
    spread = f"a model against itself, call by call, has quartiles of the wall time {100 * worst:.0f} % apart"
    if any(map(noisy, rows)):
        return f"**This machine was too noisy to compare wall times**: {spread}."
    return f"Noise: {spread}."


def _name(row: Row) -> str:
    precision = row["card"]["quantisation"]
    return f"`{row['file']}`" + ("" if precision == "none" else f" ({precision})")


def _calls(rows: list[Row]) -> Table:
    return table(
        rows,
        ("model", _name),
        ("p50", "single.p50_ms", ".2f"),
        ("p90", "single.p90_ms", ".2f"),
        ("p99", "single.p99_ms", ".2f"),
        ("p99.9", _p999, ".2f"),
        ("CPU p50", "single.cpu_p50_ms", ".2f"),
        ("p99", "single.cpu_p99_ms", ".2f"),
        ("ratio", lambda row: f"{row['steady']['tail']:.2f}{_over(row['steady'])}"),
        ("machine", "steady.machine_tail", ".2f"),
        ("load", "fresh.load_ms", ".0f"),
        ("first", "fresh.first_ms", ".1f"),
        ("peak", "fresh.peak_mb", ".0f"),
        ("MB", "size_mb", ".2f"),
    )


def _p999(row: Row) -> float | str:
    return "too few" if row["single"]["calls"] < LEAST_FOR_P999 else float(row["single"]["p999_ms"])


def _over(steady: Row) -> str:
    if steady["tail"] <= STEADY:
        return ""
    return " (over)" if steady["machine_tail"] <= STEADY else " (over, as is the machine)"


def _throughput(rows: list[Row]) -> Table:
    cpu = [f"CPU p{share} (ms)" for share in (50, 99)]
    return table(
        rows,
        ("model", _name),
        ("batch 16: /s", "batch_per_s", ".0f"),
        ("CPU ms", "batch_cpu_ms", ".2f"),
        ("Stream p90 ms", lambda row: _loadgen(row, "SingleStream", "90.00 percentile latency (ns)", 1e-6)),
        ("CPU p50, p99", lambda row: [float(row["loadgen"]["SingleStream"][key]) for key in cpu if _ran(row)], ".2f"),
        ("Offline /s", lambda row: _loadgen(row, "Offline", "Samples per second", 1.0)),
        ("Server p99 ms", lambda row: _loadgen(row, "Server", "99.00 percentile latency (ns)", 1e-6)),
        ("right", _right),
    )


def _ran(row: Row) -> bool:
    return bool(row.get("loadgen"))


def _loadgen(row: Row, scenario: str, key: str, scale: float) -> str:
    summary = row.get("loadgen", {}).get(scenario)
    if summary is None or key not in summary:
        return "not run"
    valid = "" if summary["Result is"] == "VALID" else f" ({summary['Result is'].lower()})"
    return f"{float(summary[key]) * scale:.4g}{valid}"


def _right(row: Row) -> str:
    accuracy = row.get("loadgen", {}).get("accuracy")
    return f"{accuracy['right']} of {accuracy['decisions']}" if accuracy else "no recorded collisions given"


def _sweep(rows: list[Row]) -> Table:
    titles = ("1 thread", "1, spinning", "2 threads", "2, spinning")

    def cell(place: int) -> Any:
        return lambda row: f"{row['sweep'][place]['p50_ms']:.2f} ({row['sweep'][place]['cpu_p50_ms']:.2f})"

    return table(rows, ("model", _name), *((title, cell(place)) for place, title in enumerate(titles)))


def _peers(peers: Row | None) -> Iterator[str | Table]:
    if peers:
        yield f"""
            ## Against other runtimes

            `{peers["file"]}`, the same weights, one thread; called in turn with ONNX Runtime. Ratio: ours over theirs,
            processor time, median and quartiles; below 1 ours is faster.
            """
        yield table(
            peers["rows"].items(),
            ("runtime", 0),
            ("p50 ms: theirs, ours", lambda row: [row[1].get(key) for key in ("p50_ms", "ours_p50_ms")], ".2f"),
            ("CPU ms: theirs, ours", lambda row: [row[1].get(key) for key in ("cpu_p50_ms", "ours_cpu_p50_ms")], ".2f"),
            ("ratio", lambda row: row[1].get("cpu_ratio"), ".2f"),
            ("ours is", lambda row: row[1].get("absent") or _compared(row[1]["cpu_ratio"][0])),
        )


def _compared(ratio: float) -> str:
    return "slower" if ratio > EQUAL else "equal" if ratio > 1 / EQUAL else "faster"


def _operators(operators_ms: dict[str, float]) -> str:
    return ", ".join(f"{name} {number(ms, '.3f')}" for name, ms in operators_ms.items())


def _paper(paper: Row | None) -> Iterator[str | Table]:
    if paper:
        weights = "trained by `python -m training recipe`" if paper["trained"] else "of random weights (speed only)"
        yield f"""
            ## Against the paper's networks

            Two fp32 AlexNet-LSTM networks, {weights}, take {paper["passes_cpu_ms"]:.0f} ms of processor time over eight
            frame pairs. What remains after the last frame is given as a share of that, called in turn on one thread,
            with quartiles. The recipe freezes both networks' convolutions alike, so sharing them changes nothing;
            behind one whole AlexNet (`python -m training share-backbone`) the second LSTM is trained again.

            A network that reads markers is measured from the markers on: they are tracked for slip whatever decides, at
            the cost a finger that the [slip report](slip_report.md) has. One that reads pictures starts there.
            """
        yield table(
            paper["rows"],
            ("what remains after the last frame", lambda row: f"{row['what']} ({', '.join(row['files'])})"),
            ("CPU ms", "cpu_p50_ms", ".2f"),
            ("share of two fp32 passes", lambda row: _fraction(*row["ratio"])),
            ("bound", _bound),
        )


def _fraction(middle: float, low: float, high: float) -> str:
    return f"1/{1 / middle:.0f} (1/{1 / high:.0f} .. 1/{1 / low:.0f})"


def _bound(row: Row) -> str:
    claim = row["claim"]
    return f"1/{1 / claim:.0f}: {'holds' if row['ratio'][0] <= claim else 'does not hold'}" if claim else ""


def draw(report: Row, path: Path) -> None:
    """Processor time of a call, a bar a model."""
    rows = report["models"]
    with drawing(path, size=(11, 1.2 + 0.4 * len(rows)), dpi=80) as panels:
        panel = panels[0, 0]
        panel.barh([row["file"] for row in rows], [row["single"]["cpu_p50_ms"] for row in rows], 0.6)
        panel.invert_yaxis()
        panel.set(xscale="log", xlabel="processor time of a call, ms (p50, one thread)", title=report["cpu"])
