"""The modules that a controller loads: what can be known of them without one."""

import re
from pathlib import Path

import pytest

import robot_client.robots
from robot_client.insertion.motion import TURN_DEG_S
from robot_client.robots.abb_rapid.settings import Settings
from simulation.cell.emulators.abb import rapid

MODULES = sorted(Path(robot_client.robots.__file__).parent.glob("*/*.mod"))
WORDS = (
    "alias and backward case connect const default div do else elseif endfor endfunc endif endmodule endproc endrecord"
    " endtest endtrap endwhile error exit false for from func goto if inout local mod module nostepin not noview or"
    " pers proc raise readonly record retry return step sysmodule task test then to trap true trynext undo var viewonly"
    " while with xor"
)
"""Those of RAPID, which knows no capitals: none of them may be a name."""
LONGEST_NAME = 32


def code(path):
    """The lines of a module without comments and texts."""
    return [re.sub(r'"[^"]*"', '""', line).split("!")[0].strip() for line in path.read_text().splitlines()]


def names(path):
    """Every name that a module declares, with that of each parameter."""
    for line in code(path):
        if declared := re.match(r"(?:LOCAL |TASK )?(?:VAR|PERS|CONST) \w+ (\w+)", line):
            yield declared[1]
        if routine := re.match(r"(?:PROC|FUNC \w+|TRAP) (\w+)(?:\((.*)\))?", line):
            yield routine[1]
            yield from re.findall(r"(\w+)(?:\{\*\})?(?:,|$)", routine[2] or "")


def constant(path, name):
    (value,) = re.findall(rf"CONST \w+ {name} := ([^;]+);", path.read_text())
    return value.strip('"')


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_a_module_declares_no_word_of_the_language_and_no_name_that_is_too_long(path):
    declared = list(names(path))
    assert len(declared) > 5
    assert [name for name in declared if name.lower() in WORDS.split() or len(name) > LONGEST_NAME] == []


def test_the_modules_listen_where_the_client_looks_for_them():
    """On the controller's service port, as its web services and a cell that is set up first are."""
    ours, modules = Settings(), {path.stem: path for path in MODULES}
    for name, port in (("TactileMotion", ours.motion_port), ("TactileGuard", ours.guard_port)):
        listens = constant(modules[name], "address"), int(constant(modules[name], "port"))
        assert listens == (ours.host, port) == (ours.rws.host, port)


def test_the_emulated_module_is_as_fast_as_the_true_one_whose_turns_no_ramp_exceeds():
    (path,) = (path for path in MODULES if path.stem == "TactileMotion")
    assert float(constant(path, "topSpeed")) == rapid.TOP_SPEED_MM_S
    assert float(constant(path, "turnSpeed")) == rapid.TURN_DEG_S == TURN_DEG_S
    limited = re.search(r"v\.v_ori := (\w+); IF v\.v_ori > (\w+) THEN v\.v_ori := (\w+); ENDIF", " ".join(code(path)))
    assert limited.groups() == ("speed", "turnSpeed", "turnSpeed")


def test_guidance_begins_at_a_fine_point_to_which_a_motion_led_that_goes_nowhere():
    """EGM is refused as the first motion after a restart of the controller."""
    (path,) = (path for path in MODULES if path.stem == "TactileEgm")
    begun = re.split(r"EGMAct\w+", " ".join(code(path)))[0]
    ((target, zone),) = re.findall(r"Move\w+ (\w+), \w+, (\w+),", begun)
    assert zone == "fine"
    assert re.findall(rf"{target} := (\w+)\(", begun) == ["CJointT"]
