"""When a decision would be made at once."""

import numpy as np

from training.report.depths import first_sure


def test_a_decision_that_is_sure_takes_two_steps_at_least_and_one_that_never_is_takes_all():
    after_each_step = np.array([[0.9, 0.2, 0.2, 0.2], [0.9, 0.8, 0.7, 0.2], [0.5, 0.9, 0.8, 0.2], [0.9] * 4])
    assert first_sure(after_each_step, 0.8).tolist() == [2, 2, 3, 4]
