"""The table of all commands: the package of each, its name there, and its line of help."""

from typing import NamedTuple


class Command(NamedTuple):
    """One command: the package that runs it, its name in `python -m PACKAGE NAME`, and its line of help."""

    package: str
    name: str
    help: str


GROUPS: dict[str, dict[str, Command]] = {
    "run a cell": {
        "run": Command("simulation", "run", "insert one object in the simulated cell, live"),
        "demo": Command("simulation", "demo", "a simulated cell at work, with its page, until Ctrl-C"),
        "cell": Command("simulation", "cell", "start the simulated cell on loopback sockets"),
        "serve": Command("service", "run", "start the service: cameras in, corrections out"),
        "calibrate": Command("service", "calibrate", "fit the rectification of both cameras"),
        "judge": Command("service", "judge", "find touch, hold, slip and loss in recorded runs"),
        "models": Command("service", "models", "check a folder of networks, print their cards"),
        "versions": Command("service", "versions", "versions in shadow: show, promote, roll back"),
        "replay": Command("service", "replay", "decide a recorded insertion again"),
        "doctor": Command("robot_client", "doctor", "name what is wrong with a cell, and the remedy"),
        "check": Command("robot_client", "check", "read every device and move nothing"),
        "home": Command("robot_client", "home", "reference the empty gripper"),
        "commission": Command("robot_client", "commission", "probe a new cell: wiring, and data to learn from"),
        "jog": Command("robot_client", "jog", "move the tool to a pose: up, over, down"),
        "try": Command("robot_client", "try", "try whether a device's driver keeps its promises"),
        "insert": Command("robot_client", "insert", "insert the held object (rehearses without --live)"),
        "cycle": Command("robot_client", "cycle", "pick, insert, release, part after part"),
        "replay-log": Command("robot_client", "replay", "play an episode log through the client's machine"),
    },
    "simulate": {
        "explain": Command("simulation", "explain", "which effects a scene calls for, and their cost"),
        "probe": Command("simulation", "probe", "one guarded descent, printed, drawn or filmed"),
        "imprint": Command("simulation", "imprint", "draw what the simulated sensor sees"),
        "collect": Command("simulation", "collect", "collect collisions as a dataset, on all cores"),
        "export-dataset": Command("simulation", "export-dataset", "write a dataset in LeRobot's v3 layout"),
        "evaluate": Command("simulation", "evaluate", "play every world with every object"),
        "trust": Command("simulation", "trust", "count false claims, under faults"),
        "pace": Command("simulation", "pace", "what settings cost in seconds per box"),
        "choose": Command("simulation", "choose", "settings for a time, a success and a force"),
        "scene": Command("simulation", "scene", "identify a cell's gel from its presses, as a world file"),
        "draw-worlds": Command("simulation", "draw-worlds", "drawn worlds outside the training set, as files"),
        "draw-objects": Command("simulation", "draw-objects", "random convex objects, as files"),
    },
    "train and export networks": {
        "train": Command("training", "train", "train the networks of a configuration"),
        "expect": Command("training", "expect", "measure creep in the hand, for a checkpoint"),
        "adapt": Command("training", "adapt", "fit the release to a cell's own recordings"),
        "recipe": Command("training", "recipe", "train the paper's own recipe, the baseline"),
        "board": Command("training", "board", "show a run's scalars on TensorBoard or Trackio"),
        "depths": Command("training", "depths", "write a run's gain from pressing further"),
        "transfer": Command("training", "transfer", "what accurate training physics is worth"),
        "export": Command("export", "onnx", "write a checkpoint as ONNX with its cards"),
        "verify": Command("export", "verify", "verify every network of a folder"),
        "bench": Command("export", "benchmark", "measure networks on this machine, offline"),
    },
    "study the simulation": {
        "accuracy": Command("simulation", "accuracy", "what physics accuracy costs in time"),
        "hard-probes": Command("simulation", "hard-probes", "10,000 random extreme contacts"),
        "slip-report": Command("simulation", "slip-report", "how well slip is detected, and the cost"),
        "drawn-worlds": Command("simulation", "drawn-worlds", "the closed loop in drawn worlds"),
        "sealed": Command("simulation", "sealed", "the sealed test, in another physics"),
        "learn-worlds": Command("simulation", "commission", "cells that probe, adapt, learn from work"),
        "motion-bounds": Command("simulation", "motion-bounds", "live faults: overtravel of the arm"),
        "foreign-check": Command("simulation", "foreign-check", "the finite elements beside CalculiX"),
        "grasps": Command("simulation", "grasps", "recorded grasps of real objects, judged"),
    },
}
COMMANDS: dict[str, Command] = {name: command for group in GROUPS.values() for name, command in group.items()}
