"""Commands for datasets: collect one, or export it to a format that other tools read and show."""

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any

import tyro

from service.contract import ContractError, Sensor
from service.contract.toml import read_toml
from service.durable import write_durably
from simulation.data import drawn_cells, lerobot
from simulation.data.collect import Plan, make_shard, scene_of, shard_of
from simulation.data.dataset import Dataset, DatasetWriter, slice_of
from simulation.data.manifest import MANIFEST, DatasetError, Manifest, ShardEntry, read_manifest
from simulation.data.parallel import results
from simulation.data.progress import progress
from simulation.data.sources import sources_sha256
from simulation.scene.worlds import World, load_world, training_objects

SHARD_TRIALS = 250


@dataclass(frozen=True, slots=True)
class CollectOptions:
    """Collect pokes that collided, with their labels, as Parquet shards. Run it again to resume or to add more."""

    out: Path = Path("data/probes")
    """Folder of the dataset; created if absent, continued if it holds the same collection."""
    trials_per_object: int = 7500
    """Collisions to keep per object; above one shard, rounded up to whole shards."""
    objects: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = training_objects()
    """Scene names or TOML files; or `drawn` for worlds and objects drawn over the full range of cells, `drawn-bristle`,
    `drawn-layer` and `drawn-foreign` for one tier of the gel, or finite elements."""
    sensor: str = ""
    """Name or TOML file of the fingers' sensor; default: the scenes' own."""
    around: Path | None = None
    """World file with what is known of one cell: the objects are pressed there; unstated parameters are drawn."""
    seed: int = 0
    """Seed: same seed, same data, bit for bit, whatever the number of workers."""
    workers: int = 0
    """Processes; 0 means one per core."""
    trials_per_shard: int | None = None
    """Collisions per shard; a kill costs each worker at most one shard. Default: the folder's own, or 250 at most."""
    held_out_share: float = 0.12
    """Share of re-fixtures drawn from held-out ranges (the test split)."""
    ray: str = ""
    """Address of a Ray cluster to work on instead of local processes ("local" starts one on this machine)."""


def asked_manifest(options: CollectOptions) -> Manifest:
    """The manifest of the finished collection, without shards."""
    per_shard = options.trials_per_shard
    if per_shard is None:
        per_shard = _shard_size(options)
    if options.trials_per_object < 1 or per_shard < 1:
        raise DatasetError("--trials-per-object and --trials-per-shard must be at least 1")
    if options.workers < 0 or not 0.0 <= options.held_out_share <= 1.0:
        given = f"{options.workers} and {options.held_out_share}"
        raise DatasetError(f"expected --workers from 0 on, --held-out-share from 0 to 1, got {given}")
    names = Counter(Path(name).stem for name in set(options.objects))
    if not names or max(names.values()) > 1:
        given = ", ".join(options.objects) or "none"
        raise DatasetError(f"--objects {given}: expected at least one, no two of the same name: a shard is named by it")
    for there in read_manifest(options.out).scenes if (options.out / MANIFEST).exists() else ():
        if Path(there).stem in names and there not in options.objects:
            shards = f"the shards of {Path(there).stem} in {options.out} are of {there}"
            raise DatasetError(f"--objects {', '.join(options.objects)}: {shards}; name that, or use another folder")
    try:
        sensor = Sensor.load(options.sensor) if options.sensor else None
    except ContractError as error:
        raise DatasetError(f"--sensor: {error}") from error
    scenes = {name: scene_of(name, sensor) for name in options.objects}
    cell = load_world(options.around) if options.around else World()
    fingers = {name: cell.around(scene).sensor for name, scene in scenes.items()}
    if ignored := [name for name, its_sensor in fingers.items() if sensor not in (None, its_sensor)]:
        raise DatasetError(
            f"--sensor {options.sensor}: {', '.join(ignored)} has its own; name objects, or use --around"
        )
    sensors = set(fingers.values())
    if len(sensors) > 1:
        raise DatasetError(f"the scenes have sensors {', '.join(sorted(map(str, sensors)))}: a dataset has one")
    around = f" --around {sha256(json.dumps(_known(options)).encode()).hexdigest()[:12]}" if options.around else ""
    return Manifest(
        made_by=f"simulation collect{around}",
        seed=options.seed,
        trials_per_object=options.trials_per_object,
        trials_per_shard=per_shard,
        held_out_share=options.held_out_share,
        scenes={name: scene.sha256 for name, scene in scenes.items()},
        sensor=sensors.pop(),
        physics=sources_sha256("simulation.data.collect"),
    )


def _known(options: CollectOptions) -> dict[str, Any] | None:
    """The tables of the world file."""
    if options.around is None:
        return None
    if not drawn_cells.KNOWN.keys().isdisjoint(options.objects):
        raise DatasetError(f"--around {options.around}: expected the objects that the cell packs, not drawn ones")
    return read_toml(options.around)


def _shard_size(options: CollectOptions) -> int:
    """The shard size of the collection to continue, else the default, or everything where less is requested."""
    if (options.out / MANIFEST).exists():
        return read_manifest(options.out).trials_per_shard
    return min(SHARD_TRIALS, options.trials_per_object)


def collect(arguments: list[str]) -> int:
    """Collect what is missing; 0 when the dataset is complete."""
    options = tyro.cli(CollectOptions, args=arguments, prog="tactile-insertion collect")
    asked = asked_manifest(options)
    with DatasetWriter(options.out, asked) as writer:
        writer.extend(asked)
        manifest = writer.manifest
        size, seed, share = manifest.trials_per_shard, manifest.seed, manifest.held_out_share
        plans = [
            Plan(options.out, scene, shard, size, seed, share, manifest.sensor, _known(options))
            for scene, shard in manifest.missing_shards()
        ]
        with progress("collisions", sum(plan.trials for plan in plans)) as show:
            done = 0
            for entry in _made(plans, options):
                writer.commit(entry)
                done += entry.trials
                show(done)
        writer.finish()
    print(f"{writer.manifest.trials} collisions in {len(writer.manifest.shards)} shards under {options.out}")
    return 0


def _made(plans: list[Plan], options: CollectOptions) -> Iterator[ShardEntry]:
    """Every shard as an entry of the folder; from a cluster it arrives as bytes."""
    if not options.ray:
        yield from results(make_shard, plans, options.workers)
        return
    for entry, data in results(shard_of, plans, ray=options.ray):
        write_durably(options.out / entry.name, data)
        yield entry


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """Export trials with their rendered frames as a LeRobot v3.0 dataset: Parquet with embedded PNG."""

    source: Annotated[Path, tyro.conf.Positional]
    """Folder of a collected dataset."""
    out: Path
    """New or empty folder to write into."""
    first: int = 0
    """Number of the first trial."""
    count: int = 100
    """Number of trials; each takes about 12 MB."""


def export_dataset(arguments: list[str]) -> int:
    """Export the requested trials; nothing is overwritten."""
    options = tyro.cli(ExportOptions, args=arguments, prog="tactile-insertion export-dataset")
    dataset = Dataset(options.source)
    numbers = slice_of(range(len(dataset)), options.first, options.count, options.source)
    if options.out.exists() and any(options.out.iterdir()):
        raise DatasetError(f"{options.out}: not empty; nothing is overwritten")
    options.out.mkdir(parents=True, exist_ok=True)
    with progress("trials", len(numbers)) as show:
        lerobot.export(dataset, numbers, options.out, show)
    print(f"{len(numbers)} trials under {options.out}")
    if any(dataset.trial(number).drawn for number in numbers):
        print("frames of drawn cells are equal steps of depth (in observation.state); their timestamps are nominal")
    return 0
