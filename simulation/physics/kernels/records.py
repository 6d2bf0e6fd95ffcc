"""Memory layout of the compiled kernels: a record each for constants, state and trial, arrays of nodes and rows.

Records reach a kernel as one pointer, which keeps compilation short. Units: mm, N, rad. `Any` is right for them in
annotations: numba types them, mypy cannot.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from simulation.scene.shapes import MAX_FACES

N = 18  # unknowns: object, block 0, block 1, six each; only the first six where blocks are fixed

CONSTANTS = np.dtype(
    [
        ("area", "f8"),  # of a node, mm2
        ("kn", "f8"),  # pad stiffness per area, N/mm3
        ("kt", "f8"),
        ("friction", "f8"),  # pad on object
        ("profile", "f8", (5,)),  # held surface, see shapes.held_profile
        ("faceted", "i8"),  # whether the faces count instead of the profile
        ("faces", "f8", (2, MAX_FACES, 2)),  # held sides of a polygon, see shapes.faces
        ("bottom", "f8"),  # z of the object's bottom in its own frame
        ("weight", "f8"),
        ("mass_height", "f8"),  # z of the centre of mass in the object's frame
        ("contact_k", "f8"),  # object on block, N/mm
        ("ratio", "f8"),  # tangential over normal stiffness of that contact
        ("edge_friction", "f8"),
        ("block_size", "f8", (3,)),
        ("block_weight", "f8"),
        ("base_k", "f8"),  # a block's base corner on the table, N/mm
        ("table_friction", "f8"),
        ("inertia", "f8"),  # mass over the step's time squared, N/mm; 0: no inertia
        ("unknowns", "i8"),
    ],
    align=True,
)

POSES: list[Any] = [
    ("turn", "f8", (3, 3)),  # object in hand
    ("place", "f8", (3,)),
    ("block_turn", "f8", (2, 3, 3)),  # columns: into the block, along the gap, up
    ("block", "f8", (2, 3)),  # inner top edge
]

STATE = np.dtype(
    [
        *POSES,
        ("mode", "i8", (2,)),  # TOP or WALL
        ("wrench", "f8", (6,)),  # blocks and gravity on the object, at the TCP in the hand frame
        (
            "report",
            "f8",
            (5,),
        ),  # residual N, iterations, convex rounds (0: direct), slipping nodes, cone violation N/mm2
        ("opening", "f8"),  # of the fingers
    ],
    align=True,
)

TRIAL = np.dtype(
    [
        *POSES,
        ("step_turn", "f8", (3, 3)),  # motion of the object in the hand since the load step began
        ("step", "f8", (3,)),
        ("xi", "f8", (N,)),  # twist since the rows were refreshed
        ("hand", "f8", (3, 3)),  # hand to world
        ("tcp", "f8", (3,)),
        ("start_turn", "f8", (3, 3)),  # object in the world when the load step began
        ("start", "f8", (3,)),
        ("world_turn", "f8", (3, 3)),  # object in the world now
        ("world", "f8", (3,)),
        ("coast", "f8", (3,)),  # where the centre of mass would be without forces, world
        ("spin", "f8", (3, 3)),  # scratch
        ("opening", "f8"),
        ("grad", "f8", (N,)),
        ("hess", "f8", (N, N)),  # lower half
        ("skew", "f8", (N, N)),  # what makes the coupled matrix unsymmetric
        ("full", "f8", (N, N)),
        ("twist", "f8", (N,)),
        ("filled", "i8"),  # rows in use
    ],
    align=True,
)

NODE = np.dtype(
    [
        ("x", "f8"),
        ("side", "f8"),
        ("z", "f8"),
        ("stiff", "f8"),  # its normal stiffness over that of the pad
        ("crown", "f8"),  # how far the pad's surface is set back, mm
        ("sx", "f8"),  # stretch, mm
        ("sz", "f8"),
        ("pressure", "f8"),  # N/mm2
        ("limit", "f8"),  # bound of the traction, N/mm2
        ("guess", "f8"),  # damped rounds: limit so far, N/mm2
        ("slipped", "f8"),  # 1 where the last load step slipped
    ],
    align=True,
)

SLOT = np.dtype(
    [
        ("slide", "f8", (2,)),  # stretch of its friction, mm
        ("force", "f8"),  # N
        ("guess", "f8"),  # damped rounds: bound so far, N
        ("rim", "f8"),  # how far over the block's edge a vertex begins to count, mm; 0 but in damped rounds
    ],
    align=True,
)

ROW = np.dtype(
    [
        ("line", "f8", (3, N)),  # normal and two tangents over the unknowns
        ("gap", "f8"),
        ("slide", "f8", (2,)),  # trial stretch
        ("stiffness", "f8"),
        ("friction", "f8"),
        ("bound", "f8"),
        ("slot", "i8"),
    ],
    align=True,
)

Records = NDArray[Any]


class Workspace(NamedTuple):
    """All memory of a load step: what the kernels read and write, arrays of the records above.

    constants [1]. state [1]: where the last step ended. trials [3]: the pose on trial, a spare for line searches, and
    one kept while the coupled Newton tries to finish. rows, slots, nodes [n]. foot [v, 2]: footprint, mm, object
    frame. corner [v, 3]: scratch, the footprint in a block's frame.
    """

    constants: Any
    state: Any
    trials: Any
    rows: Any
    slots: Any
    nodes: Any
    foot: Any
    corner: Any


def slot_count(vertices: int) -> int:
    """Contact slots of both blocks, without the 8 base corners that follow them."""
    return 2 * (2 + 2 * vertices)


def row_count(vertices: int) -> int:
    """Rows that can be active at once."""
    return 2 * (4 + 2 * vertices) + 8


def blank(vertices: int) -> tuple[Records, Records, Records, Records]:
    """New state [1], trials [3], rows and slots of an object with that many vertices."""
    slots = np.zeros(slot_count(vertices) + 8, dtype=SLOT)
    return np.zeros(1, dtype=STATE), np.zeros(3, dtype=TRIAL), np.zeros(row_count(vertices), dtype=ROW), slots
