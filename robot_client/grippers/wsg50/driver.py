"""Makes the WSG-50 in the protocol that its settings name; the two exclude each other on the device."""

from robot_client.grippers.wsg50.binary import BinaryWsg50
from robot_client.grippers.wsg50.settings import Settings
from robot_client.grippers.wsg50.text import TextWsg50
from robot_client.ports import Gripper


def make(settings: Settings) -> Gripper:
    return TextWsg50(settings) if settings.protocol == "text" else BinaryWsg50(settings)
