"""The paper's network: AlexNet features of both fingers' difference frames, an LSTM of 170, one linear output.

Layers carry torchvision's names (``features.0``, ``classifier.1``, ...), so that an ImageNet state dict loads
unchanged.
"""

from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from service.contract import ContractError, Sensor
from service.contract.model_card import Role
from training.networks.settings import NetworkConfig

INPUT_PX = 224
FEATURES, HIDDEN, LSTM = 9216, 4096, 170
HIDDEN_REACH, CELL_REACH = 1.001, 1e6
"""Reach of a stream: a hidden unit is a gate times a tanh; a cell unit gains at most one per step, and a million steps
are nine hours of frames.
"""
IMAGENET_SPREAD = 0.226


def convolutions() -> nn.Sequential:
    """Layers of torchvision's ``alexnet().features``: [N, 3, 224, 224] -> [N, 256, 6, 6]."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, stride=4, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1),
        nn.ReLU(),
        nn.MaxPool2d(3, 2),
    )


def difference_images(frames: Tensor, reference: Tensor, shift_px: tuple[int, int] = (0, 0)) -> Tensor:
    """Difference frames as AlexNet inputs: uint8 BGR [N, H, W, 3] twice -> float32 RGB [N, 3, 224, 224].

    The cast precedes the subtraction. ``shift_px`` (rows, columns) moves the cropped square: a random crop. Raises
    ContractError on frames higher than wide.
    """
    height, width = frames.shape[1:3]
    if height > width:
        raise ContractError(
            f"frames are {height} px high and {width} px wide, alexnet_lstm cuts a square of the height"
        )
    margin = (width - height) // 2
    square = slice(margin, margin + height)
    if shift_px == (0, 0):  # cropping bytes is cheaper than cropping floats
        frames, reference = frames[:, :, square], reference[:, :, square]
    change = (frames.float() - reference.float()).permute(0, 3, 1, 2)
    if shift_px != (0, 0):
        change = torch.roll(change, shift_px, (2, 3))[..., square]
    small = functional.interpolate(change, (INPUT_PX, INPUT_PX), mode="bilinear", align_corners=False)
    return small.index_select(1, torch.tensor([2, 1, 0], device=frames.device)) / (255.0 * IMAGENET_SPREAD)


class AlexNet(nn.Module):
    """torchvision's AlexNet without its last layer."""

    def __init__(self) -> None:
        super().__init__()
        self.features = convolutions()
        self.classifier = nn.Sequential(
            nn.Dropout(), nn.Linear(FEATURES, HIDDEN), nn.ReLU(), nn.Dropout(), nn.Linear(HIDDEN, HIDDEN), nn.ReLU()
        )


class AlexNetLstm(nn.Module):
    """One of the paper's two networks; they share nothing. Its state is (hidden, cell) of the LSTM."""

    state_size = 2 * LSTM
    uses_geometry = False
    reads_markers = False
    log_sigma: Tensor
    state_reach: Tensor

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.alexnet = AlexNet()
        self.lstm = nn.LSTMCell(2 * HIDDEN, LSTM)
        self.output = nn.Linear(LSTM, outputs)
        self.register_buffer("log_sigma", torch.zeros(2))
        reach = torch.tensor([HIDDEN_REACH, CELL_REACH]).repeat_interleave(LSTM)
        self.register_buffer("state_reach", reach, persistent=False)

    @property
    def device(self) -> torch.device:
        """Where its weights are."""
        return self.log_sigma.device

    def convolved(self, images: Tensor) -> Tensor:
        """Difference images [N, 3, 224, 224] -> frozen features [N, 9216]."""
        return self.alexnet.features(images).flatten(1)  # type: ignore[no-any-return]

    def features(self, frame: Tensor, reference: Tensor) -> Tensor:
        """Frames uint8 [B, 2, H, W, 3] -> 4096 features of either finger, left first: [B, 8192]."""
        images = difference_images(frame.flatten(0, 1), reference.flatten(0, 1))
        return self.alexnet.classifier(self.convolved(images)).reshape(-1, 2 * HIDDEN)  # type: ignore[no-any-return]

    def advance(self, features: Tensor, geometry: Tensor | None, state: Tensor) -> Tensor:  # noqa: ARG002 the paper's networks know pictures alone
        hidden, cell = self.lstm(features, (state[:, :LSTM], state[:, LSTM:]))
        return torch.cat([hidden, cell], 1)

    def read(self, convolved: Tensor) -> Tensor:
        """Final state [B, 340] after cached convolution features [B, T, 2, 9216]."""
        count, steps = convolved.shape[:2]
        features = self.alexnet.classifier(convolved.flatten(0, 2)).reshape(count, steps, 2 * HIDDEN)
        state = convolved.new_zeros(count, self.state_size)
        for step in range(steps):
            state = self.advance(features[:, step], None, state)
        return state

    def logits(self, state: Tensor) -> Tensor:
        """Class logits of a DirectionNN."""
        return self.output(state[:, :LSTM])  # type: ignore[no-any-return]

    def error(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Error (mm, deg) of a MagnitudeNN; its log sigma is one constant, the spread on validation."""
        error = self.output(state[:, :LSTM])
        return error, self.log_sigma.expand_as(error)

    def log_density(self, _state: Tensor) -> Tensor:
        """The paper has none; raises ContractError."""
        raise ContractError("alexnet_lstm has no joint density; expected the role direction or magnitude")


class AlexNetPair(nn.Module):
    """DirectionNN and MagnitudeNN of the paper, trained independently, kept in one checkpoint."""

    reads_markers = False
    reads_steps = False
    roles: tuple[Role, ...] = ("direction", "magnitude")

    def __init__(self, _settings: NetworkConfig, classes: int, _sensor: Sensor | None = None) -> None:
        super().__init__()
        self.direction = AlexNetLstm(classes)
        self.magnitude = AlexNetLstm(2)

    def of(self, role: Role) -> AlexNetLstm:
        """The network of one role; the paper has no joint density."""
        return self.direction if role == "direction" else self.magnitude


def load_imagenet(network: AlexNetLstm, path: Path) -> None:
    """Load torchvision's AlexNet weights; raises ContractError naming the file and the mismatch."""
    try:
        stored = torch.load(path, weights_only=True, map_location="cpu")
        kept = {name: value for name, value in stored.items() if not name.startswith("classifier.6.")}
        network.alexnet.load_state_dict(kept)
    except OSError as error:
        raise ContractError(f"cannot read the ImageNet weights {path}: {error.strerror}") from error
    except Exception as error:  # torch raises pickle, zip and key errors of many kinds on another file
        why = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
        raise ContractError(f"{path} does not hold torchvision's AlexNet: {why}") from error
