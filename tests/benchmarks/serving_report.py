"""docs/serving.md from what the serving benchmark measured."""

from typing import Any, NamedTuple

from reporting.page import page
from reporting.table import table
from tests.benchmarks.fleet import fleet_section


class Row(NamedTuple):
    """One measurement beside its target."""

    quantity: str
    measured: str
    target: str = ""
    reached: bool | None = None
    load: float | None = None


def serving_page(facts: dict[str, Any]) -> str:
    machine = facts["machine"]
    rows = [
        row._replace(load=(facts.get(name) or {}).get("load"))
        for name, make in ROWS.items()
        for row in _rows(name, make, facts.get(name))
    ]
    missed = [row.quantity for row in rows if row.reached is False]
    unmeasured = [row.quantity for row in rows if row.reached is None]
    return page(
        f"""
        # What serving costs

        **Missed here:** {"; ".join(missed) or "nothing"}.

        Measured by `make bench-serving` on {machine["cpu"]}, {machine["cores"]} cores. Other work shared the machine,
        so latencies are long. The load of a row is the average number of runnable processes during its measurement.
        Ratios compare alternating calls.
        """,
        table(
            rows,
            ("quantity", "quantity"),
            ("measured", "measured"),
            ("target", "target"),
            ("met", lambda row: REACHED[row.reached]),
            ("load", "load", ".1f"),
        ),
        f"**Not measured:** {'; '.join(unmeasured)}." if unmeasured else "",
        NOTES,
        "\n".join(f"- {facts[name]['note']}" for name in ROWS if "note" in facts.get(name, {})),
        fleet_section(facts),
    )


MANY_N = 300  # values that show a 99 % quantile: three lie beyond it
REACHED = {True: "yes", False: "**no**", None: "not measured"}


def _rows(name: str, make: Any, figures: dict[str, Any] | None) -> list[Row]:
    if not figures or "failed" in figures:
        return [Row(name, (figures or {}).get("failed", "not run"))]
    rows: list[Row] = make(figures)
    return rows


def both(ours: dict[str, float], theirs: dict[str, float]) -> str:
    """Two medians with their 99 % quantiles; of few values with the largest, where it was kept."""
    title, name = ("p99", "p99_ms") if min(ours["n"], theirs["n"]) >= MANY_N else ("largest", "most_ms")
    tail = f"; {title} {ours[name]:.0f} / {theirs[name]:.0f}" if name in ours and name in theirs else ""
    return f"{ours['p50_ms']:.1f} / {theirs['p50_ms']:.1f} ms (n = {ours['n']} / {theirs['n']}{tail})"


def _websocket(figures: dict[str, Any]) -> list[Row]:
    over, within = figures["websocket"], figures["in_process"]
    text = f"{both(over, within)} = {figures['ratio_p50']:.2f}; fastest tenth {figures['ratio_fastest_tenth']:.2f}"
    return [
        Row(
            "p50 from the last frame pair to the correction, WebSocket / in process",
            text,
            "1.25",
            figures["ratio_p50"] <= 1.25,
        )
    ]


def _first(figures: dict[str, Any]) -> list[Row]:
    if figures["median"] is None:
        return [Row("first decision after the start / steady state", "no start gave four decisions", "1.1", None)]
    text = f"{figures['median']:.2f} (median of {len(figures['ratios'])} starts: {figures['ratios']})"
    return [Row("first decision after the start / steady state", text, "1.1", figures["median"] <= 1.1)]


def _cameras(figures: dict[str, Any]) -> list[Row]:
    text = f"{figures['cores_at_full_rate']:.2f} cores ({figures['cpu_ms_per_frame']:.2f} ms CPU per processed frame;"
    text += f" {figures['camera_frames_per_s']:.0f} frames/s received, {figures['dropped_share']:.1%} dropped)"
    what = f"2 x {figures['asked_hz']:.0f} fps at 427 x 320, processed and recorded: CPU of the whole service"
    return [Row(what, text, "1 core", figures["cores_at_full_rate"] <= 1.0)]


def _health(figures: dict[str, Any]) -> list[Row]:
    text = f"p50 {figures['p50_ms']:.1f}, p99 {figures['p99_ms']:.1f}, max {figures['most_ms']:.0f} ms; an idle server"
    text += f" in alternation: p99 {figures['idle_server_p99_ms']:.1f}, max {figures['idle_server_most_ms']:.0f} ms"
    return [Row("/healthz under full load", text, "50 ms (p99)", figures["p99_ms"] <= 50)]


def _overload(figures: dict[str, Any]) -> list[Row]:
    text = f"p50 {figures['age_p50_ms']:.1f}, p99 {figures['age_p99_ms']:.1f} ms against"
    text += f" p50 {figures['one_frame_and_one_step_ms']:.1f}, p99 {figures['one_frame_and_one_step_p99_ms']:.1f};"
    text += f" {figures['times_overloaded']:.1f} x overload, {figures['share_within']:.1%} within the limit"
    if figures.get("share_within_of_calm") is not None:
        text += (
            f"; {figures['share_within_of_calm']:.1%} of the {figures['share_calm']:.0%} that did not wait for a core"
        )
    return [
        Row("age of results at 2 x overload: 1 frame + 1 step", text, "99 % within", figures["share_within"] >= 0.99)
    ]


def _cells(figures: dict[str, Any]) -> list[Row]:
    count, share = figures["cells_n"], figures["share_within_33_ms"]
    text = f"{share:.1%}; {figures['cores_a_cell']:.2f} cores and {figures['memory_mb_a_cell']:.0f} MB per cell,"
    text += f" {figures['perceived_share']:.0%} of the frames processed"
    cells = f"{count} cell{'s' if count > 1 else ''} at 2 x {figures['asked_hz']:.0f} fps"
    return [Row(f"{cells}, attempt in progress: slip decided within 33 ms", text, "99 %", share >= 0.99)]


ROWS = {
    "websocket": _websocket,
    "first": _first,
    "cameras 60": _cameras,
    "cameras 90": _cameras,
    "health": _health,
    "overload": _overload,
    **{f"cells {count}": _cells for count in (1, 2, 4)},
}


NOTES = """## How it was measured

- Decision: two MJPEG cameras. The time runs from the moment the eighth pair of a stopped attempt begins to leave its
  cameras until the client has the correction. The baseline passes the same JPEGs through the same session in one
  thread, in alternation.
- First decision of a fresh process, relative to the median of its next five.
- Full load: 2 x 60 fps, an attempt in progress, inference in a closed loop, three viewers.
- Overload: the station first receives more frames than it can process, which gives its capacity, then twice that rate.
  Age runs from capture to the slip decision. A step is the time that processing the two frames of that pair took.
  Results that did not wait for a core are those whose thread the kernel delayed by at most 0.2 ms.
- Cells: the stated number of services, each with two cameras and an attempt in progress, all on this machine together
  with the camera programs. Any load of a row beyond that of the cells is other work.
- CPU is the process's own time as the kernel counts it. It does not grow with the load of others, although caches do
  suffer."""
