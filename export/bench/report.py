"""The benchmark as one page and one figure."""

import json
from pathlib import Path
from typing import Any

from export.bench.measure import NOISY, NOISY_SPREAD, STEADY

NAME = "benchmark"
LEAST_FOR_P999 = 1000
"""Calls below which the slowest of a thousand was not among them."""
EQUAL = 1.05
"""A ratio of processor times beyond which one runtime is called slower than another."""


def line(row: dict[str, Any]) -> str:
    """One model on one line of the terminal."""
    single, fresh = row["single"], row["fresh"]
    return (
        f"{row['file']}: p50 {single['p50_ms']:.2f} p99 {single['p99_ms']:.2f} p99.9 {single['p999_ms']:.2f} ms,"
        f" CPU p50 {single['cpu_p50_ms']:.2f} p99 {single['cpu_p99_ms']:.2f} ms,"
        f" first {fresh['first_ms']:.1f} ms, peak {fresh['peak_mb']:.0f} MB"
    )


def noisy(row: dict[str, Any]) -> bool:
    """Whether a row's wall times say more of the neighbours than of the model."""
    return bool(row["noise"]["wall_spread"] > NOISY_SPREAD or row["single"]["crowding"] > NOISY)


def write(report: dict[str, Any], docs: Path) -> None:
    """Write benchmark.md, .json and .png."""
    (docs / f"{NAME}.json").write_text(json.dumps(report, indent=1))
    (docs / f"{NAME}.md").write_text("\n".join(_page(report)) + "\n")
    draw(report, docs / f"{NAME}.png")


def _page(report: dict[str, Any]) -> list[str]:
    rows = report["models"]
    lines = [
        "# What a decision costs",
        "",
        f"Written by `make bench` on {report['cpu']}; one thread, warm-up excluded, golden frames.",
        f"Measured at commit `{report['commit'][:12]}`.",
        "CPU is processor time, which is what to quote.",
        _noise(rows),
        "",
        f"![Processor time of a call]({NAME}.png)",
        "",
        "## One call",
        "",
        "| model | p50 | p90 | p99 | p99.9 | CPU p50 | p99 | ratio | machine | load | first | peak | MB |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
        *map(_single, rows),
        "",
        f"Ratio: p99 over p50 of the calling thread's processor time on one core, at most {STEADY}; every call counts.",
        "Machine: the same of arithmetic that never changes and takes as long, called in turn: what the hypervisor",
        "and the neighbours do to anything that runs here. Times in ms; `first` and `peak` (beyond interpreter and",
        "libraries) are of a fresh process.",
        "",
        "## Throughput and LoadGen",
        "",
        "MLPerf LoadGen as a library. Server: a third of the capacity offered at random, p99 of the answers. Right",
        "directions: what LoadGen logged in its accuracy mode on recorded collisions, in the same run.",
        "",
        "| model | batch 16: /s | CPU ms | Stream p90 ms | CPU p50, p99 | Offline /s | Server p99 ms | right |",
        "|---|---|---|---|---|---|---|---|",
        *map(_throughput, rows),
        "",
        "## Threads and spinning",
        "",
        "p50 ms (CPU ms of all threads). Spinning threads burn a core that the cameras need.",
        "",
        "| model | 1 thread | 1, spinning | 2 threads | 2, spinning |",
        "|---|---|---|---|---|",
        *map(_sweep, rows),
        "",
    ]
    return lines + _peers(report) + _operators(rows) + _paper(report)


def _noise(rows: list[dict[str, Any]]) -> str:
    worst = max(row["noise"]["wall_spread"] for row in rows)
    spread = f"a model against itself, call by call, has quartiles of the wall time {100 * worst:.0f} % apart"
    if any(map(noisy, rows)):
        return f"**This machine was too noisy to compare wall times**: {spread}."
    return f"Noise: {spread}."


def _name(row: dict[str, Any]) -> str:
    precision = row["card"]["quantisation"]
    return f"`{row['file']}`" + ("" if precision == "none" else f" ({precision})")


def _single(row: dict[str, Any]) -> str:
    single, fresh = row["single"], row["fresh"]
    cells = [f"{single[key]:.2f}" for key in ("p50_ms", "p90_ms", "p99_ms", "p999_ms", "cpu_p50_ms", "cpu_p99_ms")]
    if single["calls"] < LEAST_FOR_P999:
        cells[3] = "too few"
    steady = row["steady"]
    cells += [
        f"{steady['tail']:.2f}{_over(steady)}",
        f"{steady['machine_tail']:.2f}",
        f"{fresh['load_ms']:.0f}",
        f"{fresh['first_ms']:.1f}",
    ]
    return "| " + " | ".join([_name(row), *cells, f"{fresh['peak_mb']:.0f}", f"{row['size_mb']:.2f}"]) + " |"


def _over(steady: dict[str, Any]) -> str:
    if steady["tail"] <= STEADY:
        return ""
    return " (over)" if steady["machine_tail"] <= STEADY else " (over, as is the machine)"


def _throughput(row: dict[str, Any]) -> str:
    loadgen = row.get("loadgen", {})

    def cell(scenario: str, key: str, scale: float) -> str:
        summary = loadgen.get(scenario)
        if summary is None or key not in summary:
            return "not run"
        valid = "" if summary["Result is"] == "VALID" else f" ({summary['Result is'].lower()})"
        return f"{float(summary[key]) * scale:.4g}{valid}"

    accuracy = loadgen.get("accuracy")
    right = f"{accuracy['right']} of {accuracy['decisions']}" if accuracy else "no recorded collisions given"
    cells = [
        _name(row),
        f"{row['batch_per_s']:.0f}",
        f"{row['batch_cpu_ms']:.2f}",
        cell("SingleStream", "90.00 percentile latency (ns)", 1e-6),
        ", ".join(f"{float(loadgen['SingleStream'][f'CPU p{share} (ms)']):.2f}" for share in (50, 99))
        if loadgen
        else "",
        cell("Offline", "Samples per second", 1.0),
        cell("Server", "99.00 percentile latency (ns)", 1e-6),
        right,
    ]
    return "| " + " | ".join(cells) + " |"


def _sweep(row: dict[str, Any]) -> str:
    cells = [f"{entry['p50_ms']:.2f} ({entry['cpu_p50_ms']:.2f})" for entry in row["sweep"]]
    return "| " + " | ".join([_name(row), *cells]) + " |"


def _peers(report: dict[str, Any]) -> list[str]:
    peers = report.get("peers")
    if not peers:
        return []
    lines = [
        "## Against other runtimes",
        "",
        f"`{peers['file']}`, the same weights, one thread; called in turn with ONNX Runtime. Ratio: ours over theirs,",
        "processor time, median [quartiles]; below 1 ours is faster.",
        "",
        "| runtime | p50 ms: theirs, ours | CPU ms: theirs, ours | ratio | ours is |",
        "|---|---|---|---|---|",
    ]
    for name, row in peers["rows"].items():
        if "absent" in row:
            lines.append(f"| {name} | | | | {row['absent']} |")
            continue
        middle, low, high = row["cpu_ratio"]
        result = "slower" if middle > EQUAL else "equal" if middle > 1 / EQUAL else "faster"
        wall = f"{row['p50_ms']:.2f}, {row['ours_p50_ms']:.2f}"
        cpu = f"{row['cpu_p50_ms']:.2f}, {row['ours_cpu_p50_ms']:.2f}"
        lines.append(f"| {name} | {wall} | {cpu} | {middle:.2f} [{low:.2f}, {high:.2f}] | {result} |")
    return [*lines, ""]


def _operators(rows: list[dict[str, Any]]) -> list[str]:
    lines = ["## Where the time goes", "", "Mean ms a call by operator (profiler's clock, wall time).", ""]
    for row in rows:
        spent = ", ".join(f"{name} {ms:.3f}" for name, ms in row["operators_ms"].items())
        lines.append(f"- {_name(row)}: {spent}")
    return [*lines, ""]


def _paper(report: dict[str, Any]) -> list[str]:
    paper = report.get("alexnet")
    if paper is None:
        return []
    weights = "trained by `python -m training recipe`" if paper["trained"] else "of random weights (speed only)"
    lines = [
        "## Against the paper's networks",
        "",
        f"Two fp32 AlexNet-LSTM networks, {weights}, over eight frame pairs take {paper['passes_cpu_ms']:.0f} ms of",
        "processor time; what remains after the last frame as a share of that, called in turn on one thread. The",
        "recipe freezes both networks' convolutions alike, so sharing them changes nothing; behind one whole AlexNet",
        "(`python -m training share-backbone`) the second LSTM is trained again.",
        "",
        "A network that reads markers is measured from the markers on: they are tracked for slip whatever decides, at",
        "the cost a finger that the [slip report](slip_report.md) has. One that reads pictures starts there.",
        "",
        "| what remains after the last frame | CPU ms | share of two fp32 passes | bound |",
        "|---|---|---|---|",
    ]
    for row in paper["rows"]:
        middle, low, high = row["ratio"]
        claim = row["claim"]
        bound = "" if claim is None else f"1/{1 / claim:.0f}: {'holds' if middle <= claim else 'does not hold'}"
        share = f"1/{1 / middle:.0f} [1/{1 / high:.0f}, 1/{1 / low:.0f}]"
        lines.append(f"| {row['what']} ({', '.join(row['files'])}) | {row['cpu_p50_ms']:.2f} | {share} | {bound} |")
    return [*lines, ""]


def draw(report: dict[str, Any], path: Path) -> None:
    """Processor time of a call, a bar a model."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    rows = report["models"]
    figure, axes = plt.subplots(figsize=(11, 1.2 + 0.4 * len(rows)), layout="constrained")
    axes.barh([row["file"] for row in rows], [row["single"]["cpu_p50_ms"] for row in rows], 0.6)
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="processor time of a call, ms (p50, one thread)", title=report["cpu"])
    axes.grid(visible=True, which="both", axis="x", alpha=0.2)
    figure.savefig(path, dpi=80)
    plt.close(figure)
