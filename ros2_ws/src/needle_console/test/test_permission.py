"""Which pages may hold, and which may only watch and stop."""

from __future__ import annotations

import pytest

from needle_console.console_parameters import ConsoleParameters
from needle_console.page.desk import Desk
from needle_console.view.snapshot import Snapshot
from needle_core.errors import UserError
from needle_core.status_messages import DeviceStatus


@pytest.mark.parametrize("is_local", [True, False])
@pytest.mark.parametrize("hold_real_rig", [True, False])
@pytest.mark.parametrize("simulated", [True, False, None])
def test_a_real_rig_is_held_at_its_own_machine_where_that_is_allowed(
    simulated: bool | None, hold_real_rig: bool, is_local: bool
) -> None:
    desk = Desk(ConsoleParameters(hold_real_rig=hold_real_rig))
    desk.send((Snapshot(device=DeviceStatus(simulated=simulated)),))
    may_hold = not desk.why_no_hold(is_local)
    assert may_hold == (simulated is True or (hold_real_rig and is_local))


def test_a_device_that_is_not_heard_may_be_a_real_one() -> None:
    desk = Desk(ConsoleParameters())
    assert desk.why_no_hold(True).startswith("only watching: hold_real_rig is off")
    desk = Desk(ConsoleParameters(hold_real_rig=True))
    assert "at its own machine" in desk.why_no_hold(False)


def test_one_port_cannot_serve_both() -> None:
    with pytest.raises(UserError, match="wants two"):
        ConsoleParameters(port=8081)
