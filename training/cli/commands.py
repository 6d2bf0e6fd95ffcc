"""Train and evaluate networks: ``python -m training train training/configs/compact.toml``."""

import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from service.contract import ContractError
from service.contract.text import fitted, run_command

Device = Literal["cpu", "cuda"]


def train(
    config: Annotated[Path, tyro.conf.Positional], data: Path | None = None, device: Device | None = None
) -> None:
    """Train one run from its TOML file; started again, it resumes.

    Args:
        config: the run's TOML file, see training/configs/.
        data: dataset folder, instead of the one in the config.
        device: what computes the steps, instead of the config's device; the default is the CPU.
    """
    from training.config import RunConfig
    from training.fit.train import train as run

    loaded = RunConfig.load(config)
    if device is not None:
        loaded = loaded.model_copy(update={"device": device})
    if data is not None:
        loaded = loaded.model_copy(update={"data": loaded.data.model_copy(update={"path": str(data)})})
    print_table(run(loaded).figures)
    print(f"checkpoint: {loaded.folder / 'checkpoint.pt'}")


def recipe(
    config: Annotated[Path, tyro.conf.Positional], data: Path | None = None, device: Device | None = None
) -> None:
    """Train the paper's own recipe (two AlexNet-LSTM networks), the baseline; started again, it resumes.

    Args:
        config: the recipe's TOML file, see training/configs/alexnet_lstm.toml.
        data: dataset folder, instead of the one in the config.
        device: what computes the steps, instead of the config's device; the default is the CPU.
    """
    from training.config import RecipeConfig
    from training.fit.recipe import train_recipe

    loaded = RecipeConfig.load(config)
    if device is not None:
        loaded = loaded.model_copy(update={"device": device})
    if data is not None:
        loaded = loaded.model_copy(update={"data": str(data)})
    print_table(train_recipe(loaded).figures)
    print(f"checkpoint: {loaded.folder / 'checkpoint.pt'}")


def board(
    name: Annotated[Literal["tensorboard", "trackio"], tyro.conf.Positional],
    run: Annotated[Path, tyro.conf.Positional],
    follow: bool = False,
) -> None:
    """Show a run's scalars on TensorBoard or Trackio, which nothing else requires.

    Args:
        name: board to use.
        run: folder of the run, such as runs/pressing.
        follow: keep following the run until Ctrl-C.
    """
    from training.report.boards import show_on

    print(f"{show_on(name, run, follow=follow)} epochs of {run} on {name}")


def depths(run: Annotated[Path, tyro.conf.Positional], out: Path = Path("docs")) -> None:
    """Write the gain of a depth-reading network from pressing further, its coverage by reach, and its strangeness.

    Args:
        run: folder of the run, such as runs/pressing.
        out: folder of depths.md and depths.json.
    """
    from training.report.depths import write_depths

    print(write_depths(run, out))


def transfer(plan: Annotated[Path, tyro.conf.Positional], out: Path = Path("docs")) -> None:
    """Test networks that were trained in one tier of the gel on presses in others: what accurate physics is worth.

    Args:
        plan: TOML file of networks and test sets, such as training/configs/transfer/plan.toml.
        out: folder of transfer.md and transfer.json.
    """
    from training.report.transfer import write_transfer

    print(write_transfer(plan, out))


def adapt(
    recordings: Annotated[Path, tyro.conf.Positional],
    start: Annotated[Path, tyro.conf.arg(name="from")],
    out: Path = Path("runs/adapted"),
    around: Path | None = None,
    record: Path | None = None,
    json: Path | None = None,
    seed: int = 0,
) -> int:
    """Fit a released network to one cell; exit status 3 if the release stays, with the missing evidence.

    It learns from probes of known error and from successful insertions. Stages from calibration alone to all weights
    are compared on held-out fixtures; one is accepted only if it is likelier and no count is worse. Calibration, which
    makes the release less sure and changes nothing else, is accepted where the release is proven too sure.

    Args:
        recordings: folder of recordings of the cell, real or simulated.
        start: released checkpoint.
        out: folder of the new checkpoint.pt; `tactile-insertion export` makes a model folder of it.
        around: dataset of simulated presses of the cell's objects, from `collect --around`, for one more stage.
        record: record of the cell's commissioning; of all probes only those that it lists count, and not those before
            a mistake was repaired, or with another gel. Nor does work before them.
        json: file for the verdict as data.
        seed: seed of folds and batches.
    """
    import torch

    from reporting.files import write_json
    from training.adapt.adapt import adapt as fit
    from training.adapt.adapt import report as plain_data
    from training.config import alone_in

    if not 0 <= seed < 2**32:
        raise ContractError(f"--seed {seed}: expected 0 to {2**32 - 1}")
    if json is not None and json.is_dir():
        raise ContractError(f"--json {json} is a folder, expected a file")
    for folder in (out, *([json.parent] if json else [])):
        folder.mkdir(parents=True, exist_ok=True)  # now: the fit takes minutes
    torch.set_num_threads(1)
    with alone_in(out):
        comparison = fit(recordings, start, out, around=around, record=record, seed=seed)
    print(comparison.text())
    if json is not None:
        write_json(json, plain_data(comparison))
    return 0 if comparison.accepted else 3


def expect(
    checkpoint: Annotated[Path, tyro.conf.Positional], insertions: Annotated[tuple[Path, ...], tyro.conf.Positional]
) -> None:
    """Measure on played insertions how a blocked object creeps in the hand, for the checkpoint's belief.

    Args:
        checkpoint: a ``checkpoint.pt`` written by ``train``; it is replaced.
        insertions: logs (.insertions.jsonl) of `tactile-insertion evaluate` with these networks.
    """
    from dataclasses import replace

    from training.fit.checkpoint import Checkpoint
    from training.fit.expectations import of_insertions

    loaded = Checkpoint.load(checkpoint)
    creep = of_insertions(insertions, loaded.expectations)
    replace(loaded, expectations=creep).save(checkpoint)
    print(creep.model_dump_json(indent=1))


def print_table(figures: dict[str, dict[str, float]]) -> None:
    names = "trials accuracy chance ece wrong_side_x mae_x_mm mae_theta_deg rmse_x_mm rmse_theta_deg"
    columns = (names + " coverage90_x coverage90_theta").split()
    for row, values in figures.items():
        print(fitted(f"{row}: " + ", ".join(f"{name} {values[name]:.3g}" for name in columns), 2))


COMMANDS: dict[str, Callable[..., Any]] = {
    "train": train,
    "recipe": recipe,
    "board": board,
    "depths": depths,
    "transfer": transfer,
    "expect": expect,
    "adapt": adapt,
}
RESUMED = ("train", "recipe")
"""Commands that go on where they were interrupted."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; invalid input gives one line on standard error and exit code 2."""
    return run_one_of(COMMANDS, arguments, "training", RESUMED)


def run_one_of(
    commands: dict[str, Callable[..., Any]], arguments: Sequence[str] | None, package: str, resumed: Sequence[str] = ()
) -> int:
    """Run the command that the arguments name; its exit status."""
    parse = partial(tyro.extras.subcommand_cli_from_dict, commands, args=arguments, prog=f"python -m {package}")
    name = [*(sys.argv[1:] if arguments is None else arguments), package][0]
    refused = (ContractError, OSError)  # a folder that cannot be written is bad input, too
    return run_command(name, lambda: int(parse() or 0), refused, resumes=name in resumed)
