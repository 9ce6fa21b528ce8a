"""The power state machine of a CiA 402 drive: states, commands, and what the statusword shows."""

from __future__ import annotations

import enum


class PowerState(enum.Enum):
    """A state, with its bits of the statusword (bits 0..3, 5 and 6)."""

    NOT_READY = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION = 0x0F
    FAULT = 0x08


class Order(enum.Enum):
    """Orders of a controlword to the power state: (mask, value)."""

    DISABLE_VOLTAGE = (0x02, 0x00)
    QUICK_STOP = (0x06, 0x02)
    SHUTDOWN = (0x07, 0x06)
    SWITCH_ON = (0x0F, 0x07)
    ENABLE_OPERATION = (0x0F, 0x0F)


FAULT_RESET = 0x80

_S, _O = PowerState, Order
# The numbers are those of the standard's figure.
TRANSITIONS: dict[tuple[PowerState, Order], PowerState] = {
    (_S.SWITCH_ON_DISABLED, _O.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 2
    (_S.READY_TO_SWITCH_ON, _O.SWITCH_ON): _S.SWITCHED_ON,  # 3
    # As most drives do: 3 and 4 in one.
    (_S.READY_TO_SWITCH_ON, _O.ENABLE_OPERATION): _S.OPERATION_ENABLED,
    (_S.SWITCHED_ON, _O.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 4
    (_S.OPERATION_ENABLED, _O.SWITCH_ON): _S.SWITCHED_ON,  # 5
    (_S.SWITCHED_ON, _O.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 6
    (_S.READY_TO_SWITCH_ON, _O.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 7
    (_S.READY_TO_SWITCH_ON, _O.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 7
    (_S.OPERATION_ENABLED, _O.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 8
    (_S.OPERATION_ENABLED, _O.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 9
    (_S.SWITCHED_ON, _O.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 10
    (_S.SWITCHED_ON, _O.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 10
    (_S.OPERATION_ENABLED, _O.QUICK_STOP): _S.QUICK_STOP_ACTIVE,  # 11
    (_S.QUICK_STOP_ACTIVE, _O.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 12
    (_S.QUICK_STOP_ACTIVE, _O.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 16
}


def order_of(controlword: int) -> Order | None:
    """Return what a controlword asks for; None for a pattern that asks for nothing."""
    for order in Order:
        mask, value = order.value
        if controlword & mask == value:
            return order
    return None


def next_state(state: PowerState, controlword: int) -> PowerState:
    """Return the state that a controlword leads to; most lead nowhere."""
    order = order_of(controlword)
    return state if order is None else TRANSITIONS.get((state, order), state)
