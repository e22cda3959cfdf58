"""When another partner is met, and which."""

import numpy as np
import pytest

from sb3_belief.common.redraws import RedrawSchedule


def test_a_partner_stays_as_long_as_it_should():
    schedule = RedrawSchedule(every=3)
    assert [schedule.number(passed) for passed in range(7)] == [0, 0, 0, 1, 1, 1, 2]
    assert RedrawSchedule(every=None).number(10**6) == 0


def test_draws_follow_the_weights():
    schedule = RedrawSchedule(seed=1)
    drawn = np.bincount([schedule.draw(number, [1, 0, 3]) for number in range(2000)], minlength=3)
    assert drawn[1] == 0 and abs(drawn[0] / 2000 - 0.25) < 4 * np.sqrt(0.25 * 0.75 / 2000)


def test_copies_draw_by_themselves_or_together():
    def draws(schedule, copy_seed):
        return [schedule.draw(number, [1] * 6, copy_seed) for number in range(30)]

    apart, together = RedrawSchedule(), RedrawSchedule(unit="rollouts", per_copy=False)
    assert draws(apart, 0) == draws(apart, 0) != draws(apart, 1)
    assert draws(together, 0) == draws(together, 1) != draws(RedrawSchedule(unit="rollouts", per_copy=False, seed=1), 0)


@pytest.mark.parametrize(
    "wrong",
    [{"every": 0}, {"every": True}, {"every": 1.5}, {"seed": -1}, {"unit": "steps"}, {"per_copy": 1}, {"per_copy": False}],
)
def test_wrong_values_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        RedrawSchedule(**wrong)
