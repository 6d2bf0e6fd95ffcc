"""Hard data: truncated, duplicated, reordered, altered or foreign data are named and refused."""

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import numpy as np

from service.contract import ContractError, FrameSpec, TactileFrame
from service.contract.frames import decode_frame, encode_frame
from service.contract.wire import parse_client, parse_service
from simulation.data.dataset import Dataset, DatasetWriter
from simulation.data.manifest import MANIFEST, DatasetError, Manifest, ShardEntry
from tests.hard_cases.instead import blind, waved_through
from tests.hard_cases.registry import Guard, case, not_refused
from tests.simulation.strategies import made_up_dataset, made_up_manifest, made_up_trial

FRAME = encode_frame(TactileFrame("left", 1, 2, np.zeros((32, 40, 3), np.uint8)))


def listed_again(_commit: object) -> Callable[[DatasetWriter, ShardEntry], None]:
    """Shards are listed without looking at their names."""

    def commit(writer: DatasetWriter, entry: ShardEntry) -> None:
        writer.manifest = writer.manifest.model_copy(update={"shards": (*writer.manifest.shards, entry)})

    return commit


def cut_or_filled(decode: Callable[..., TactileFrame]) -> Callable[..., TactileFrame]:
    """Messages are brought to the length of the one frame that this case is about."""
    return lambda message, spec=None: decode(message.ljust(len(FRAME), b"\0")[: len(FRAME)], spec)


SCRATCH = tempfile.TemporaryDirectory(prefix="hard-cases-")  # until this process ends


@lru_cache
def _dataset() -> Path:
    """Two committed shards of 12 made-up trials."""
    return made_up_dataset(Path(SCRATCH.name), [made_up_trial(k) for k in range(24)])


@contextmanager
def damaged(change: Callable[[Path], object]) -> Iterator[Path]:
    """A copy of the dataset after ``change`` was let loose on it."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "probes"
        shutil.copytree(_dataset(), folder)
        change(folder)
        yield folder


def _opened(change: Callable[[Path], object], *, verify: bool = False) -> Callable[[], object]:
    def call() -> object:
        with damaged(change) as folder:
            return [Dataset(folder, verify=verify).trial(index) for index in range(24)]

    return call


SHARD = "rectangle-00001.parquet"


@case(
    "data",
    why="a kill or a full disk leaves a file with a valid beginning",
    holds="a shard cut at any length is named and refused: cuts not refused",
    guard=Guard("simulation.data.manifest:ShardEntry.must_be_whole", "no shard is checked", waved_through),
)
def shards_cut_short(seed: int) -> float:
    size = (_dataset() / SHARD).stat().st_size
    cuts = [0, 1, size // 2, size - 1, int(np.random.default_rng(seed).integers(size))]
    return not_refused(
        [_opened(lambda f, n=n: (f / SHARD).write_bytes((f / SHARD).read_bytes()[:n])) for n in cuts],
        DatasetError,
        "truncated",
    )


@case(
    "data",
    why="a flipped bit changes a label but not the length",
    holds="an altered shard fails its hash: flips not refused",
    guard=Guard(
        "simulation.data.manifest:ShardEntry.must_be_whole",
        "contents are not hashed",
        lambda check: lambda entry, folder, **_: check(entry, folder),
    ),
)
def shards_with_a_flipped_bit(seed: int) -> float:
    places = np.random.default_rng(seed).integers(100, (_dataset() / SHARD).stat().st_size - 100, 4)

    def flip(folder: Path, place: int) -> None:
        data = bytearray((folder / SHARD).read_bytes())
        data[place] ^= 1
        (folder / SHARD).write_bytes(bytes(data))

    return not_refused([_opened(lambda f, p=int(p): flip(f, p), verify=True) for p in places], DatasetError, "SHA-256")


@case(
    "data",
    why="a shard under another's name has the right format and the wrong trials",
    holds="shards that changed places or are doubled are refused: not refused",
    guard=Guard("simulation.data.dataset:DatasetWriter.commit", "a shard is listed twice", listed_again),
)
def shards_reordered_or_doubled(_seed: int) -> float:
    def swap(folder: Path) -> None:
        first, second = folder / "rectangle-00000.parquet", folder / SHARD
        data = first.read_bytes()
        first.write_bytes(second.read_bytes())
        second.write_bytes(data)

    def twice() -> None:
        with damaged(lambda _: None) as folder, DatasetWriter(folder, made_up_manifest()) as writer:
            writer.commit(writer.manifest.shards[0])

    return not_refused([_opened(swap, verify=True), twice], DatasetError)


@case(
    "data",
    why="a folder may hold a manifest of another version, a truncated one, or one that lists missing files",
    holds="each is refused by name: not refused",
    guard=Guard(
        "simulation.data.manifest:read_manifest",
        "the parser's own errors come through",
        lambda _: lambda folder: Manifest.model_validate_json((folder / MANIFEST).read_bytes()),
    ),
)
def manifests_that_do_not_fit(_seed: int) -> float:
    def edit(folder: Path, **changes: object) -> None:
        path = folder / MANIFEST
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    changes: list[Callable[[Path], object]] = [
        lambda f: edit(f, schema_version=99),
        lambda f: edit(f, stranger=1),
        lambda f: (f / MANIFEST).write_text("{"),
        lambda f: (f / MANIFEST).unlink(),
        lambda f: (f / SHARD).unlink(),
    ]
    return not_refused([_opened(change) for change in changes], DatasetError)


@case(
    "data",
    why="a NaN label poisons every average that includes it",
    holds="trials with non-finite labels or states are refused on writing: not refused",
    guard=Guard("simulation.data.trial:Trial.check", "every number counts as finite", blind),
)
def trials_that_are_no_numbers(_seed: int) -> float:
    gel = made_up_trial().gel.copy()
    gel[3, 1, 2, 3, 0] = np.nan
    changes = [{"x_mm": np.nan}, {"theta_deg": np.inf}, {"gap_width_mm": -np.inf}, {"gel": gel}, {"onset_frame": 25}]
    return not_refused([lambda c=c: made_up_trial(0, **c).check() for c in changes], DatasetError)


@case(
    "data",
    why="a binary frame is read by offsets, so a wrong header reads beyond its end or into the wrong shape",
    holds="cut, lengthened and altered frames are refused: not refused",
    guard=Guard(
        "service.contract.frames:decode_frame", "a message is truncated or padded to its length", cut_or_filled
    ),
)
def frames_with_a_wrong_header(seed: int) -> float:
    rng = np.random.default_rng(seed)
    whole = encode_frame(TactileFrame("left", 1, 2, rng.integers(0, 256, (32, 40, 3), dtype=np.uint8)))
    spec = FrameSpec(height_px=32, width_px=41)
    bad = [b"", whole[:10], whole[:-1], whole + b"x", b"TIF2" + whole[4:], whole[:4] + b"\x07" + whole[5:]]
    calls = [lambda m=m: decode_frame(m) for m in bad]
    return not_refused([*calls, lambda: decode_frame(whole, spec)], ContractError)


@case(
    "data",
    why="JSON from the network may contain anything",
    holds="malformed, oversized and foreign messages are refused in one line: not refused",
    guard=Guard("service.contract.wire:MAX_TEXT_BYTES", "a message may have any length", 1 << 40),
)
def messages_from_elsewhere(seed: int) -> float:
    rng = np.random.default_rng(seed)
    huge = '{"type":"abort","insertion_id":"a","cause":"operator","reason":"x"}' + " " * 2_000_000
    texts = ["", "{", "[]", "null", '{"type":"fly"}', '{"type":"arm"}', huge, rng.bytes(60), b"\xff\xfe" * 20]
    calls = [lambda t=t, p=p: p(t) for t in texts for p in (parse_client, parse_service)]
    return not_refused(calls, ContractError)
