import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from training.fit import parallel

ROOT = Path(__file__).resolve().parents[3]


def test_alone_nothing_is_shared_or_averaged():
    chosen = np.arange(5)
    assert parallel.first()
    assert parallel.share(chosen) is chosen
    assert parallel.seeds(3, 4) == [3, 4]
    assert parallel.agreed({"score": 1.0}) == {"score": 1.0}

    def loss(batch):
        return batch

    with parallel.group(), parallel.first_goes_first():
        assert parallel.averaged(torch.nn.Linear(1, 1), loss) is loss


@pytest.mark.parametrize("processes", [2, 3])
def test_shares_are_equally_long_and_no_trial_is_in_two(processes, monkeypatch):
    monkeypatch.setattr(parallel, "together", lambda: True)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: processes)
    shares = []
    for rank in range(processes):
        monkeypatch.setattr(torch.distributed, "get_rank", lambda rank=rank: rank)
        shares.append(parallel.share(np.arange(10)))
        assert parallel.seeds(1) == [1, rank]
    assert {len(share) for share in shares} == {10 // processes}
    assert len(set(np.concatenate(shares).tolist())) == 10 // processes * processes


@pytest.mark.slow
def test_two_processes_under_torchrun_end_with_the_same_weights(tmp_path):
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command += ["-m", "tests.training.fit.parallel_run", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    first, second = (torch.load(tmp_path / f"weights-{rank}.pt", weights_only=True) for rank in (0, 1))
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert (tmp_path / "two" / "checkpoint.pt").is_file()
