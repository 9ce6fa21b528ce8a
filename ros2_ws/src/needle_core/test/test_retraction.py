"""Hold and service calls of a retraction."""

from __future__ import annotations

import pytest

from needle_core.retraction import RETRACT, STOP_STEERING, HoldOrder, Retraction

RELEASED, OUT = False, True
HELD, FREE = HoldOrder(True), HoldOrder(False)
STOPS, RETRACTS = HoldOrder(False, (STOP_STEERING,)), HoldOrder(True, (RETRACT,))
# Button, time [s], whether a controller steers, whether the hold counts; the order.
Step = tuple[bool, float, bool, bool, HoldOrder]
STORIES: dict[str, tuple[Step, ...]] = {
    "steering stops first, and each service is called once": (
        (OUT, 0.0, True, False, STOPS),
        (OUT, 0.0, True, False, FREE),
        (OUT, 0.0, False, False, HELD),
        (OUT, 0.0, False, True, RETRACTS),
        (OUT, 0.0, False, True, HELD),
        # The needle is out and the button still pressed: no second call, and no hold.
        (OUT, 8.0, False, False, HELD),
        (OUT, 8.1, False, True, FREE),
        (OUT, 8.2, True, False, FREE),
        (RELEASED, 9.0, False, False, FREE),
        (OUT, 9.1, False, True, RETRACTS),
    ),
    "a needle that is out ends the hold": (
        (OUT, 0.0, False, True, RETRACTS),
        (OUT, 0.9, False, True, HELD),
        (OUT, 1.1, False, True, FREE),
        # Steering that begins now gets no hold.
        (OUT, 1.2, True, False, FREE),
    ),
    "steering that begins meanwhile gets no hold": (
        (OUT, 0.0, False, False, HELD),
        (OUT, 0.0, True, True, STOPS),
    ),
}


@pytest.mark.parametrize("story", STORIES)
def test_a_retraction_orders_hold_and_services(story: str) -> None:
    retraction = Retraction()
    for held, now, steering, counts, order in STORIES[story]:
        assert retraction.update(held, now, steering=steering, hold_counts=counts) == order
