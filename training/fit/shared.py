"""The recipe's two networks behind one whole AlexNet: what the paper keeps apart, at half the weights.

The convolutions are frozen and equal anyway. Here the fully connected layers of the trained direction network serve
both, and only the magnitude network's LSTM and output are trained again, on what those layers give. The direction
network does not change by a bit.
"""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor

from service.contract import ContractError
from training.config import RecipeConfig, StageConfig, pin, refuse_other_grounds
from training.data.dataset import Source, data_sha256, load_table, open_source
from training.data.recipe_data import Rows, load_rows
from training.fit.checkpoint import Checkpoint
from training.fit.loop import Stage, fit
from training.fit.recipe import finish, head_stage
from training.networks.alexnet import AlexNetLstm, AlexNetPair

STAGE = StageConfig(epochs=8, batch=16, learning_rate=5e-4, weight_decay=0.0, patience=3)
READ_AT_ONCE = 8


def share_backbone(config: RecipeConfig, source: Source | None = None) -> Checkpoint:
    """Train the second LSTM on a finished recipe's features and save ``<runs>/<name>_shared/checkpoint.pt``.

    Raises ContractError if the recipe has not finished, or has changed since the folder was begun.
    """
    path = config.folder / "checkpoint.pt"
    if not path.is_file():
        raise ContractError(f"{path} is missing; expected a finished run of `python -m training recipe`")
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    recipe = Checkpoint.load(path)
    pair: AlexNetPair = recipe.build()
    source = open_source(config.data) if source is None else source
    digest = data_sha256(source)
    refuse_other_grounds(config.folder, digest)  # its kept features are of those data
    table = load_table(source, Path(config.cache) / digest[:16], len(source))
    rows = load_rows(config, source, table, pair.direction)
    fresh = AlexNetLstm(2)
    fresh.alexnet = pair.direction.alexnet
    named = config.model_copy(update={"name": f"{config.name}_shared"})
    named.folder.mkdir(parents=True, exist_ok=True)
    pin(named.folder, named, digest + recipe.weights_sha256())
    print("magnitude", fit(fresh, _stage(fresh, rows, _read(fresh, rows)), named.folder, config.seed))
    pair.magnitude.load_state_dict(fresh.state_dict())
    return finish(named, pair, rows, digest)


def _read(network: AlexNetLstm, rows: Rows) -> NDArray[np.float16]:
    """What the fully connected layers give of every row's frames: float16 [N, 8, 8192]."""
    network.eval()
    parts = []
    with torch.inference_mode():
        for start in track(range(0, len(rows.convolved), READ_AT_ONCE), description="fully connected features"):
            convolved = torch.from_numpy(rows.convolved[start : start + READ_AT_ONCE].astype(np.float32))
            features = network.alexnet.classifier(convolved.flatten(0, 2))
            parts.append(features.reshape(*convolved.shape[:2], -1).half().numpy())
    return np.concatenate(parts)


def _stage(network: AlexNetLstm, rows: Rows, features: NDArray[np.float16]) -> Stage:
    def read(chosen: NDArray[np.int64]) -> Tensor:
        state = torch.zeros(len(chosen), network.state_size)
        for step in range(features.shape[1]):
            state = network.advance(torch.from_numpy(features[chosen, step].astype(np.float32)), None, state)
        return state

    return head_stage(
        "magnitude", STAGE, network, rows, read, [*network.lstm.parameters(), *network.output.parameters()]
    )
