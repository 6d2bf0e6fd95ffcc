"""CONTRIBUTING.md's statements about the checks before a commit."""

import re
import subprocess

import yaml

from tests.docs.commands import ROOT


def test_pre_commit_runs_what_make_lint_runs():
    dry = ["make", "-n", "lint", "VENV=/nowhere", "-o", "/nowhere/ready"]
    printed = subprocess.run(dry, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    made = [line.removeprefix("/nowhere/bin/") for line in printed.splitlines() if line.startswith("/nowhere/bin/")]
    (repository,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    hooks = [re.search(r"exec (.*)'", hook["entry"]) for hook in repository["hooks"]]
    assert repository["repo"] == "local"
    assert [hook[1] for hook in hooks if hook] == made
    assert len(made) == 4
