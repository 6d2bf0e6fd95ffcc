"""Kind and sizes of a network."""

from pydantic import Field

from service.contract.frames import Contract

FRAMES_PER_DECISION = 8


class NetworkConfig(Contract):
    """Kind and sizes of a network; ``kind`` is a key of :data:`training.networks.NETWORKS`.

    ``affine_fit`` adds the motion of the object as a whole, fitted to the field, to the convolutions' features.
    """

    kind: str = "compact"
    front_width: int = Field(default=32, ge=4, le=4096)
    trunk_width: int = Field(default=24, ge=4, le=4096)
    feature_size: int = Field(default=96, ge=8, le=4096)
    state_size: int = Field(default=128, ge=8, le=4096)
    dropout: float = Field(default=0.1, ge=0, lt=1)
    affine_fit: bool = False
