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

        Measured on {machine["cpu"]}, {machine["cores"]} cores, by `make bench-serving`. The machine was shared with
        other work. The load of each row is the average number of runnable processes while it was measured, so times
        are long, and ratios are between calls made in turn.
        """,
        table(
            rows,
            ("quantity", "quantity"),
            ("measured", "measured"),
            ("at least", "target"),
            ("reached", lambda row: REACHED[row.reached]),
            ("load", "load", ".1f"),
        ),
        f"**Missed here:** {'; '.join(missed) or 'nothing'}.",
        f"**Not measured:** {'; '.join(unmeasured)}." if unmeasured else "",
        fleet_section(facts),
        NOTES,
        "\n".join(f"- {name}: {facts[name]['note']}" for name in ROWS if "note" in facts.get(name, {})),
    )


REACHED = {True: "yes", False: "**no**", None: "not measured"}


def _rows(name: str, make: Any, figures: dict[str, Any] | None) -> list[Row]:
    if not figures or "failed" in figures:
        return [Row(name, (figures or {}).get("failed", "not run"))]
    rows: list[Row] = make(figures)
    return rows


def both(ours: dict[str, float], theirs: dict[str, float]) -> str:
    """Two medians with their 99 % quantiles."""
    return f"{ours['p50_ms']:.1f} / {theirs['p50_ms']:.1f} ms (p99 {ours['p99_ms']:.0f} / {theirs['p99_ms']:.0f})"


def _peers(figures: dict[str, Any]) -> list[Row]:
    ours = figures["servers"]["service"]
    rows = []
    for peer, label, limit in (("mlserver", "MLServer gRPC", 0.5), ("litserve", "LitServe", 0.35)):
        theirs, share = figures["servers"][peer], figures[f"ratio to {peer}"]
        model, megabytes = figures.get("model", "direction.step.onnx"), figures["payload_bytes"] / 1e6
        what = f"binary inference p50, `{model}`, {megabytes:.2f} MB a call, service / {label}"
        what += f" {figures['versions'][peer]}"
        rows.append(Row(what, f"{both(ours, theirs)} = {share:.2f}", f"{limit}", share <= limit))
    inside = figures["servers"]["in process"]
    rows.append(Row("the same in process, p50", f"{inside['p50_ms']:.2f} ms", reached=True))
    return rows


def _websocket(figures: dict[str, Any]) -> list[Row]:
    over, within = figures["websocket"], figures["in_process"]
    text = f"{both(over, within)} = {figures['ratio_p50']:.2f}; fastest tenth {figures['ratio_fastest_tenth']:.2f}"
    return [
        Row("last frame pair to correction p50, WebSocket / in process", text, "1.25", figures["ratio_p50"] <= 1.25)
    ]


def _first(figures: dict[str, Any]) -> list[Row]:
    if figures["median"] is None:
        return [Row("first decision after ready / steady", "no start gave four decisions", "1.1", None)]
    text = f"{figures['median']:.2f} (median of {len(figures['ratios'])} starts: {figures['ratios']})"
    return [Row("first decision after ready / steady", text, "1.1", figures["median"] <= 1.1)]


def _cameras(figures: dict[str, Any]) -> list[Row]:
    text = f"{figures['cores_at_full_rate']:.2f} cores ({figures['cpu_ms_per_frame']:.2f} ms CPU a frame perceived;"
    text += f" {figures['camera_frames_per_s']:.0f} frames/s came, {figures['dropped_share']:.1%} dropped)"
    what = f"2 x {figures['asked_hz']:.0f} fps at 427 x 320, perceived and recorded: CPU of the whole service"
    return [Row(what, text, "1 core", figures["cores_at_full_rate"] <= 1.0)]


def _health(figures: dict[str, Any]) -> list[Row]:
    text = f"p50 {figures['p50_ms']:.1f}, p99 {figures['p99_ms']:.1f}, most {figures['most_ms']:.0f} ms; an idle server"
    text += f" asked in turn: p99 {figures['idle_server_p99_ms']:.1f}, most {figures['idle_server_most_ms']:.0f} ms"
    return [Row("/healthz under full load", text, "50 ms (p99)", figures["p99_ms"] <= 50)]


def _overload(figures: dict[str, Any]) -> list[Row]:
    text = f"p50 {figures['age_p50_ms']:.1f}, p99 {figures['age_p99_ms']:.1f} ms against"
    text += f" p50 {figures['one_frame_and_one_step_ms']:.1f}, p99 {figures['one_frame_and_one_step_p99_ms']:.1f};"
    text += f" {figures['times_overloaded']:.1f} x overloaded, within in {figures['share_within']:.1%}"
    if figures.get("share_within_of_calm") is not None:
        text += f"; of the {figures['share_calm']:.0%} that the kernel did not make wait,"
        text += f" in {figures['share_within_of_calm']:.1%}"
    return [
        Row("age of results at 2 x overload: 1 frame + 1 step", text, "99 % within", figures["share_within"] >= 0.99)
    ]


def _cells(figures: dict[str, Any]) -> list[Row]:
    count, share = figures["cells_n"], figures["share_within_33_ms"]
    text = f"{figures['cores_a_cell']:.2f} cores and {figures['memory_mb_a_cell']:.0f} MB a cell;"
    text += f" {figures['perceived_share']:.0%} of the frames perceived, slip judged within 33 ms in {share:.1%}"
    what = (
        f"{count} cell{'s' if count > 1 else ''} at once, each 2 x {figures['asked_hz']:.0f} fps, an attempt under way"
    )
    return [Row(what, text, "99 % within", share >= 0.99)]


ROWS = {
    "peers": _peers,
    "websocket": _websocket,
    "first": _first,
    "cameras 60": _cameras,
    "cameras 90": _cameras,
    "health": _health,
    "overload": _overload,
    **{f"cells {count}": _cells for count in (1, 2, 4)},
}


NOTES = """How it was measured:

- Inference: one closed loop of one client, ten calls to each server in turn, one thread a session everywhere. The
  service is asked by `tritonclient[http]` with binary tensors,
  MLServer by `tritonclient[grpc]` with raw tensors and without parallel workers, LitServe with base64 in JSON.
- Decision: two MJPEG cameras; from the moment the eighth pair of a stopped attempt begins to leave its cameras to the
  correction in the client's hand, against the same JPEGs through the same session in one thread, in turn.
- First decision: of a fresh process, against the median of the next five of the same process.
- Full load: 2 x 60 fps, an attempt under way, inference in a closed loop, three viewers.
- Overload: the station is first given more frames than it can perceive, which tells the rate it can; then twice that
  rate. Age is counted from capture to the slip decision, a step is what perceiving the two frames of a pair took just
  then. Of the calm results the kernel let the perceiving thread wait for a core for at most 0.2 ms of their life.
- Cells: as many services as stated, each with two cameras and an attempt under way, all on this machine, the cameras'
  programs too. What the load of a row has beyond the cells is other work.
- CPU is the process's own time from the kernel: it does not grow with what others use, though caches do suffer."""
