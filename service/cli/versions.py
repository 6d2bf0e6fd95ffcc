"""`python -m service versions`: which version of the networks decides in a running service, and manual changes."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import httpx

from service.contract import ContractError
from service.contract.text import Parser, fitted, printable
from service.contract.token import TOKEN_FILE, is_here, read_token, state_folder

ASKED = {
    "show": ("GET", ""),
    "shadow": ("POST", "/shadow"),
    "drop": ("DELETE", "/shadow"),
    "promote": ("POST", "/promote"),
    "rollback": ("POST", "/rollback"),
}
TIMEOUT_S = 60.0


def main(arguments: Sequence[str]) -> int:
    """Ask a running service and print its versions; raises ContractError with its reason if it refuses."""
    parser = Parser(prog="tactile-insertion versions", description="versions of the networks in a running service")
    parser.add_argument("what", nargs="?", choices=ASKED, default="show", help="show (default), or a manual change")
    parser.add_argument("folder", nargs="?", type=Path, help="for shadow: folder of the networks to run in shadow")
    parser.add_argument("--url", default="http://127.0.0.1:8000", help="address of the service (%(default)s)")
    parser.add_argument("--token-file", type=Path, help="file of the token; default that of a service of this user")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")
    options = parser.parse_args(arguments)
    if (options.what == "shadow") != (options.folder is not None):
        raise ContractError("a folder goes with shadow, and with nothing else: versions shadow FOLDER")
    state = _ask(options)
    print(json.dumps(state) if options.json else "\n".join(fitted(printable(line)) for line in described(state)))
    return 0


def _ask(options: argparse.Namespace) -> dict[str, Any]:
    method, path = ASKED[options.what]
    token_file = options.token_file or _own_token_file(options)
    try:
        token = {"Authorization": f"Bearer {read_token(token_file)}"} if token_file else {}
    except OSError as error:
        raise ContractError(f"--token-file {token_file}: {error.strerror}") from None
    params = {"folder": str(options.folder.resolve())} if options.folder else None
    try:
        url = f"{options.url.rstrip('/')}/v1/versions{path}"
        ours = httpx.create_ssl_context()  # with the environment's authorities, and none of its proxies
        answer = httpx.request(
            method, url, params=params, headers=token, timeout=TIMEOUT_S, verify=ours, trust_env=False
        )
        state = answer.json()
    except (httpx.HTTPError, httpx.InvalidURL, ValueError) as error:
        raise ContractError(f"no service answers at {options.url}: {str(error) or type(error).__name__}") from None
    if answer.is_error:
        raise ContractError(str(state.get("error", answer.status_code)))
    return dict(state)


def _own_token_file(options: argparse.Namespace) -> Path | None:
    """The token of this user's service, for a change on this machine; to show versions there, none is needed."""
    if options.what == "show":
        return None
    if not is_here(options.url):
        raise ContractError(f"--token-file is needed for {options.url}: this machine's token is not sent elsewhere")
    return state_folder() / TOKEN_FILE


def described(state: dict[str, Any]) -> list[str]:
    """One line per version and caution, and any problem."""
    active = state["active"]
    lines = [f"active    {active['version']}  {active['name']}", *_cautions(active)]
    for role in ("shadow", "previous"):
        if one := state[role]:
            evidence = f"evidence {one['evidence']:.2f} of {state['enough']:g}, after {one['ended_n']} insertions"
            lines += [f"{role:<9} {one['version']}  {one['name']}: {evidence}", *_cautions(one)]
    lines += [f"rejected  {version}  {why}" for version, why in state["rejected"].items()]
    return [*lines, *([state["problem"]] if state["problem"] else [])]


def _cautions(version: dict[str, Any]) -> list[str]:
    return [f"          caution: {one}" for one in version.get("cautions", ())]
