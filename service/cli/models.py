"""`python -m service models FOLDER`: the networks that the service would load from a folder, with their cards."""

import json
from collections.abc import Sequence
from pathlib import Path

from pydantic import JsonValue

from service.contract.model_card import UNTRAINED, ModelCard
from service.contract.shipped import released_models
from service.contract.text import Parser, fitted, printable
from service.decision.models import LoadedModel, load_models


def main(arguments: Sequence[str]) -> int:
    """Print every card; raises ModelError (exit status 2) wherever the service would refuse to start."""
    parser = Parser(prog="tactile-insertion models", description="check a folder, print its cards")
    parser.add_argument(
        "folder", nargs="?", type=Path, default=released_models(), help="folder of *.onnx files; default the released"
    )
    parser.add_argument("--json", action="store_true", help="print files, hashes and cards as JSON")
    options = parser.parse_args(arguments)
    models = load_models(options.folder)
    deciding = {step.path for step in models.steps}
    if options.json:
        print(json.dumps([_facts(model, decides=model.path in deciding) for model in models.models]))
        return 0
    for model in models.models:
        print("\n".join(fitted(printable(line)) for line in describe(model, decides=model.path in deciding)))
    print("".join(f"{fitted(printable(f'caution: {one}'))}\n" for one in models.cautions), end="")
    return 0


def _facts(model: LoadedModel, *, decides: bool) -> dict[str, JsonValue]:
    card: JsonValue = model.card.model_dump(mode="json")
    return {"file": model.path.name, "decides": decides, "sha256": model.sha256, "card": card}


def _seed(run: dict[str, JsonValue]) -> str:
    return f", seed {run['seed']}" if "seed" in run else ""


def _trained(card: ModelCard) -> str:
    """The figures, or why the network is not to be trusted."""
    if why := card.training_run.get(UNTRAINED):
        return f"UNTRAINED: {why}"
    shown = {name: f"{value:,.0f}" if value >= 1000 else f"{value:.3g}" for name, value in card.validation.items()}
    figures = ", ".join(f"{name} {value}" for name, value in shown.items()) or "no figures"
    return f"{figures} ({'recordings of its cell' if card.training_run.get('adapted') else 'simulated'})"


def _input(card: ModelCard) -> str:
    """What a decision is made of: pairs of pictures, fields of markers, or steps of depth."""
    if card.pressing:
        lattice = card.pressing.lattice
        return f"steps of {card.pressing.step_mm:g} mm on {lattice.rows} x {lattice.columns} points"
    if card.markers:
        return f"fields of {card.markers.rows} x {card.markers.columns} markers, of both fingers"
    return f"frame pairs, {card.frame.width_px} x {card.frame.height_px} {card.frame.colour}"


def _precision(card: ModelCard) -> str:
    return "not quantised" if card.quantisation == "none" else f"{card.quantisation} quantisation"


def describe(model: LoadedModel, *, decides: bool) -> list[str]:
    """A few lines about one file: its role, inputs, origin and figures."""
    card = model.card
    size_mb = model.path.stat().st_size / 1e6
    return [
        f"{model.path.name}: {card.name}, {card.role}, {card.form} form, {size_mb:.2f} MB"
        + (", decides" if decides else ""),
        f"  takes       {card.frames_per_decision} {_input(card)}, {_precision(card)}",
        f"  calibrated  temperature {card.calibration.temperature:.3g}, refuses below {card.min_confidence:.0%}",
        f"  validation  {_trained(card)}",
        f"  from        commit {card.git_commit[:12]}, data {card.training_data_sha256[:12]}{_seed(card.training_run)}",
        f"  verified    on {card.verified_on_cpu}",
        f"  sha256      {model.sha256}",
    ]
