"""What the accuracy of the physics is worth: networks of one tier each, tested in cells of another."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from reporting.machine import commit
from reporting.page import page, publish
from reporting.statistics import Estimate, mean, wilson
from reporting.table import Table, table
from service.contract import ContractError
from service.contract.frames import Contract, first_error
from service.contract.toml import read_toml
from service.contract.wire import PRESS_MM
from training.adapt.stages import trainer_of
from training.config import DataConfig
from training.data.pressed import Pressed, load_pressed
from training.fit.checkpoint import Checkpoint
from training.metrics.figures import Predictions, figures
from training.networks.pressing import STEP_MM

NAME = "transfer"
Row = dict[str, Any]


class Trained(Contract):
    """One network: its checkpoint, how many presses were collected for it, in which cells, and the CPU time of each."""

    name: str
    checkpoint: str
    presses: int = Field(ge=1)
    cpu_ms: float = Field(gt=0)


class TestSet(Contract):
    """Presses that no network was trained on: a dataset folder of cells in one physics."""

    name: str
    data: str


class Comparison(Contract):
    """The first network is what the others are compared with."""

    trained: tuple[Trained, ...] = Field(min_length=2)
    test_sets: tuple[TestSet, ...] = Field(min_length=1)
    note: str = ""


def write_transfer(plan: Path, out: Path) -> Path:
    """Test all networks of a plan, and write ``<out>/transfer.md`` and ``.json``.

    Raises ContractError on a wrong key, and where a network was trained on a test set.
    """
    try:
        comparison = Comparison.model_validate_json(json.dumps(read_toml(plan)))
    except ValidationError as error:
        raise ContractError(f"{plan}: {first_error(error)}") from error
    presses_of = {
        test_set.name: load_pressed(DataConfig(path=test_set.data, views=1)) for test_set in comparison.test_sets
    }
    for one in comparison.trained:
        network = Checkpoint.load(Path(one.checkpoint))
        if network.pressing is None:
            kind = network.network.kind
            raise ContractError(f"{plan}: {one.name} is a {kind} network, expected one that reads steps of depth")
        for name, presses in presses_of.items():
            if presses.sha256 == network.training_data_sha256:
                raise ContractError(f"{plan}: {one.name} was trained on the test set {name}; expected fresh presses")
    data = {
        "commit": commit(),
        "note": comparison.note,
        "press_mm": PRESS_MM,
        "test_sets": {name: len(presses) for name, presses in presses_of.items()},
        "rows": [row for name, presses in presses_of.items() for row in _tested(comparison.trained, name, presses)],
    }
    publish(out, NAME, transfer_page(data), data)
    return out / f"{NAME}.md"


def _tested(trained: Sequence[Trained], name: str, presses: Pressed) -> Iterator[Row]:
    """A row of each network on the same presses."""
    first: NDArray[np.bool_] | None = None
    for one in trained:
        predictions = predicted(Checkpoint.load(Path(one.checkpoint)), presses)
        right = predictions.right
        first = right if first is None else first
        yield {
            "tested_on": name,
            **one.model_dump(exclude={"checkpoint"}),
            "direction": list(wilson(float(right.sum()), len(right))),
            "gained": list(mean((right.astype(float) - first).tolist())),
            **{key: figures(predictions)[key] for key in ("mae_x_mm", "mae_theta_deg")},
            **{key: figures(predictions)[key] for key in ("coverage90_x", "coverage90_theta")},
        }


def predicted(checkpoint: Checkpoint, presses: Pressed) -> Predictions:
    """Calibrated predictions of all presses, read as deep as the software presses."""
    trainer = replace(trainer_of(checkpoint.build(), presses), most_steps=round(PRESS_MM / STEP_MM))
    return trainer.predict(np.arange(len(presses)), pictures=False).rescaled(checkpoint.scales)


def transfer_page(data: Row) -> str:
    """The whole of docs/transfer.md from transfer.json."""
    return page(*_parts(data))


def _parts(data: Row) -> Iterator[str | Table]:
    counts = ", ".join(f"{count} in {name}" for name, count in data["test_sets"].items())
    yield "# What the accuracy of the physics is worth, simulated"
    yield data["note"]
    yield f"""
        ## How it was measured

        Written by `make transfer` at commit `{data["commit"][:12]}`. Networks of one architecture, trained by one
        recipe, learnt from presses of drawn objects in drawn cells, each in one tier of the gel. All were tested on the
        same fresh draws: {counts}. They read {data["press_mm"]:g} mm of pressing, as shipped. *Gained*: how many more
        directions are right than in the first row, press by press, with the 95 % interval. Shares have Wilson
        intervals. The CPU time is that of collecting a press that was kept.
        """
    for name in data["test_sets"]:
        yield f"## Tested in {name}"
        yield table(
            [row for row in data["rows"] if row["tested_on"] == name],
            ("trained in", "name"),
            ("presses", "presses", ",d"),
            ("CPU ms a press", "cpu_ms", ".0f"),
            ("CPU min of collecting", lambda row: row["presses"] * row["cpu_ms"] / 60e3, ".0f"),
            ("direction", "direction", ".1%"),
            ("gained", lambda row: points(row["gained"])),
            ("MAE x mm", "mae_x_mm", ".2f"),
            ("MAE yaw deg", "mae_theta_deg", ".2f"),
            ("90 % coverage x", "coverage90_x", ".0%"),
            ("90 % coverage yaw", "coverage90_theta", ".0%"),
        )


def points(gained: Sequence[float]) -> str:
    """A difference of shares with its interval, as points."""
    of = Estimate(*(100.0 * value for value in gained))
    return f"{of:+.1f} points"
