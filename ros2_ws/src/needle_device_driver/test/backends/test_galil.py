"""Galil protocol against scripted bytes: set-up, orders, states, and lost or refused replies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from needle_core.errors import UserError
from needle_device_driver.axes.link import DriveError
from needle_device_driver.backends.galil import GalilProtocol
from needle_device_driver.parameters import BACKENDS, DeviceDriverParameters
from needle_device_driver.polled.drive_protocol import DriveReply
from needle_device_driver.polled.text_link import TextLink
from needle_device_driver.procedure import Procedure, T, run

BEAT = "nsbeat=8"
PROGRAM = (
    "DL|#NSDOG|nsbeat=nsbeat-1|WT 10|JP #NSDOG,nsbeat>0|STAC|#NSSTOP|WT 2|JP #NSSTOP,(_BGA+_BGC)>0"
    "|MOAC|#NSIDLE|WT 10|JP #NSIDLE|\\"
)
REQUEST = "MG 7,_TPA,_RPA,_TSA,_SCA,_TPC,_RPC,_TSC,_SCC,_XQ1,TIME"
STATE = "7.0000 {a} {c} {line}.0000 {time}.0000\r\n:"
REST = "0.0000 0.0000 44.0000 0.0000"


class Script:
    """Protocol on a controller that answers as scripted; by default it accepts all commands."""

    def __init__(self, **parameters: Any) -> None:
        settings = DeviceDriverParameters(
            insertion_drive="galil",
            rotation_drive="galil",
            galil_rotation_channel="C",
            **parameters,
        )
        self.link = TextLink("galil", GalilProtocol.terminators)
        axes = settings.axes_of(BACKENDS["galil"])
        self.protocol = GalilProtocol(settings, axes, self.link)
        self.states: list[tuple[int, dict[str, DriveReply]]] = []
        self.protocol.on_status = lambda number, at: self.states.append((number, dict(at)))
        self.replies = {"\x12\x16": "DMC4143 Rev 1.3b\r\n:", "MG _CN0": "-1.0000\r\n:"}
        self.replies |= dict.fromkeys(("MG _BGA", "MG _BGC"), " 0.0000\r\n:")
        self.replies |= {"MG _XQ1": "-1.0000\r\n:", PROGRAM: "::"}
        self.reply: Callable[[str], str] = lambda _: ""
        self.sent: list[str] = []
        self.link.open()

    def take(self) -> list[str]:
        """Return the sent commands, except beats; | is a line end in a download."""
        data = b"".join(self.link.pop_outgoing()).decode()
        program, backslash, rest = data.partition("\\")
        lines = rest if backslash else data
        commands = lines.replace(";", "\r").split("\r")[:-1]
        return [program.replace("\r", "|") + "\\"] * bool(backslash) + commands

    def receive(self, text: str) -> None:
        for line in self.link.receive((text.encode("latin-1"),)):
            self.protocol.on_line(line)

    def run(self, procedure: Procedure[T]) -> T:
        """Run a procedure that gets an answer to each command within 1 ms."""

        def wait(is_there: Callable[[], bool], seconds: float) -> None:
            commands = self.take()
            self.sent += [command for command in commands if command != BEAT]
            for command in commands:
                self.receive(self.reply(command) or self.replies.get(command, ":"))
            self.link.now += 0.001 if is_there() else seconds

        return run(procedure, wait, lambda: self.link.now)

    def set_up(self) -> Script:
        for axis in ("insertion", "rotation"):
            self.run(self.protocol.set_up(axis))
        self.sent.clear()
        return self

    def state(self, a: str = REST, c: str = REST, line: int = 1, time: int = 100) -> DriveReply:
        """Request the state, answer, and return the state of the insertion axis."""
        self.protocol.request(7)
        self.take()
        self.receive(STATE.format(a=a, c=c, line=line, time=time))
        number, replies = self.states.pop()
        assert number == 7
        return replies["insertion"]


def test_the_set_up_moves_nothing_and_the_last_axis_starts_the_watchdog() -> None:
    script = Script()
    assert script.run(script.protocol.identify()) == "DMC4143 Rev 1.3b"
    for axis in ("insertion", "rotation"):
        script.run(script.protocol.set_up(axis))
    script.run(script.protocol.write_limits("rotation", -70, 80))
    # Ramps of 0.05 and 0.5 m/s^2, and 20 and 100 rad/s^2, in steps of 1024 counts/s^2.
    assert script.sent == [
        *("CW 1", "VF 10.4", "\x12\x16"),
        *("STA", "MG _BGA", "MOA", "ACA=999424", "DCA=10000384", "ERA=10000", "OEA=1"),
        *("FLA=2147483647", "BLA=-2147483648", "SDA=10000384"),
        *("STC", "MG _BGC", "MOC", "ACC=207872", "DCC=1043456", "ERC=1043", "OEC=1"),
        *("FLC=2147483647", "BLC=-2147483648", "SDC=1043456", "MG _CN0"),
        *("HX1", PROGRAM, "MG _XQ1", "HX1", "XQ#NSDOG,1", "FLC=80", "BLC=-70"),
    ]


@pytest.mark.parametrize(
    ("replies", "message"),
    [
        ({"MG _CN0": " 1.0000\r\n:"}, r"active high \(CN 1\), expected active low"),
        ({"MG _CN0": "x\r\n:"}, r"its _CN0 is 'x', expected a number"),
        ({PROGRAM: "?::"}, r"refuses DL \(error .*: halt the controller's own program \(HX\)"),
        ({"XQ#NSDOG,1": "?"}, r"refuses XQ#NSDOG,1 \(error .* free its program memory"),
    ],
)
def test_a_refused_set_up_and_its_fix(replies: dict[str, str], message: str) -> None:
    script = Script()
    script.replies |= {"TC1": "6 Number out of range\r\n:", **replies}
    with pytest.raises(DriveError, match=message):
        script.set_up()


def test_an_old_controller_needs_no_sd() -> None:
    script = Script()
    script.replies |= dict.fromkeys(("SDA=10000384", "SDC=1043456"), "?")
    assert not script.set_up().state().fault


def test_orders() -> None:
    script = Script().set_up()
    orders: tuple[tuple[Callable[[GalilProtocol], None], list[str]], ...] = (
        (lambda at: at.beat(), [BEAT]),
        (lambda at: at.power("insertion", True), ["SHA"]),
        (lambda at: at.move_to("insertion", -12, 2001), ["PTA=1", "SPA=2002", "PAA=-12"]),
        (lambda at: at.move_to("insertion", 5, 900), ["SPA=900", "PAA=5"]),
        (lambda at: at.stop("insertion"), ["STA"]),
        (lambda at: at.move_to("insertion", 6, 900), ["PTA=1", "SPA=900", "PAA=6"]),
        (lambda at: at.power("rotation", False), ["STC", "MOC"]),
        (lambda at: at.request(7), [REQUEST]),
    )
    for order, expected in orders:
        order(script.protocol)
        assert script.take() == expected


@pytest.mark.parametrize(
    ("a", "expected"),
    [
        # Without a blank before the sign.
        ("-12.0000-13.0000 140.0000 0.0000", DriveReply(-12, True, True)),
        ("5.0000 5.0000 40.0000 3.0000", DriveReply(5, False, False, home_switch=True)),
        ("5.0000 5.0000 36.0000 2.0000", DriveReply(5, False, False, inner_switch=True)),
        (
            "5.0000 5.0000 108.0000 8.0000",
            DriveReply(5, False, False, fault="exceeded its following error and switched off"),
        ),
    ],
)
def test_a_state(a: str, expected: DriveReply) -> None:
    script = Script(insertion_reverse=False).set_up()
    script.protocol.power("insertion", True)
    script.receive(":")
    script.state("0.0000 0.0000 12.0000 0.0000")
    assert script.state(a) == expected


def test_a_reversed_axis_has_its_outer_switch_at_the_forward_end() -> None:
    at = Script(insertion_reverse=True).set_up().state("5.0000 5.0000 36.0000 2.0000")
    assert (at.home_switch, at.inner_switch) == (True, False)


@pytest.mark.parametrize(
    ("reference", "speed"), [(-40, 2001), (-55, 2002), (-92, 2300), (-9000, 100_000)]
)
def test_a_lagging_axis_catches_up_within_two_cycles(reference: int, speed: int) -> None:
    script = Script(max_speed=0.005).set_up()
    script.state(f"0.0000 {reference}.0000 12.0000 0.0000")
    script.protocol.move_to("insertion", 0, 2001)
    assert script.take()[1] == f"SPA={speed + speed % 2}"


def test_an_axis_rests_at_its_target_in_position_tracking() -> None:
    script = Script().set_up()
    script.protocol.move_to("insertion", 50, 100)
    script.receive(":::")
    assert script.state("20.0000 21.0000 140.0000 0.0000").moving
    assert not script.state("49.0000 50.0000 140.0000 0.0000").moving


def test_a_limit_ends_position_tracking_but_not_that_of_newer_orders() -> None:
    script = Script().set_up()
    stopped = "50.0000 50.0000 8.0000 3.0000"
    script.protocol.move_to("insertion", 50, 100)
    script.receive(":::")
    script.state(stopped)
    script.protocol.request(6)
    script.protocol.move_to("insertion", 60, 900)
    assert script.take()[1:] == ["PTA=1", "SPA=900", "PAA=60"]
    script.receive(STATE.format(a=stopped, c=REST, line=1, time=100).replace("7", "6", 1) + ":::")
    script.protocol.move_to("insertion", 70, 900)
    assert script.take() == ["SPA=900", "PAA=70"]


def test_the_watchdog_and_a_restart_show() -> None:
    script = Script().set_up()
    assert not Script().state(line=5).timed_out
    assert not script.state(line=4).timed_out
    assert script.state(line=5).timed_out
    script.run(script.protocol.clear_fault("insertion"))
    assert script.sent == []
    script.run(script.protocol.clear_fault("rotation"))
    assert script.sent[-1] == "XQ#NSDOG,1"
    assert script.state(time=200) == script.state(time=300)
    # The clock restarted, or the program ended: lost until the next set-up.
    assert script.state(time=250).rebooted
    assert script.state(time=260).rebooted
    assert not script.set_up().state(time=270).rebooted
    assert script.state(time=280, line=-1).rebooted


def test_an_acknowledged_stop_code_is_no_fault_until_the_axis_was_on() -> None:
    script = Script().set_up()
    off, on = (f"0.0000 0.0000 {bits}.0000 8.0000" for bits in (44, 12))
    assert not script.state(off).fault
    assert not script.state(on).fault
    assert script.state(off).fault
    script.run(script.protocol.clear_fault("insertion"))
    assert not script.state(off).fault


def test_a_refused_order_is_a_fault_with_its_reason() -> None:
    script = Script().set_up()
    script.protocol.move_to("insertion", 1, 100)
    script.receive("::?")
    assert script.take()[-1] == "TC1"
    script.receive("20 Begin not valid with motor off\r\n:")
    fault = "refuses an order (error 20 Begin not valid with motor off)"
    assert script.state().fault == fault
    script.run(script.protocol.clear_fault("insertion"))
    script.run(script.protocol.clear_fault("rotation"))
    assert not script.state().fault
    assert script.sent == []
    # A controller may refuse MO while the axis moves.
    script.protocol.power("insertion", False)
    script.receive(":?")
    assert script.take() == ["STA", "MOA"]


@pytest.mark.parametrize(
    "before",
    [
        "",
        ":::::::",
        "?",
        "7.0000 1/0000 0.0000 44.0000\r\n:",
        "\xcd\xc7 \xba\r\n",
        "45.0000\r\n:",
        STATE.format(a=REST, c=REST, line=1, time=100).replace("7", "5", 1),
    ],
)
def test_a_state_restores_the_order_of_replies(before: str) -> None:
    """A beat and an order were sent before the request, and their replies are lost or wrong."""
    script = Script().set_up()
    script.protocol.beat()
    script.protocol.stop("insertion")
    script.protocol.request(6)
    script.protocol.request(7)
    script.receive(before)
    state = STATE.format(a=REST, c=REST, line=1, time=100)
    if before.startswith("\xcd"):
        # The rest of a garbled line is lost with it.
        script.receive(":")
    for byte in state:
        script.receive(byte)
    ((number, replies),) = script.states
    assert (number, replies["insertion"].position, replies["rotation"].fault) == (7, 0, "")
    # The next replies are matched again.
    script.take()
    script.protocol.move_to("rotation", 1, 2)
    script.receive("::?")
    assert script.take()[-1] == "TC1"


def test_the_release_switches_off_and_ends_the_program() -> None:
    script = Script().set_up()
    moving = [" 0.0000\r\n:", " 1.0000\r\n:"]
    script.reply = lambda command: moving.pop() if command == "MG _BGA" else ""
    # The reply to a beat is lost.
    script.protocol.beat()
    script.take()
    script.run(script.protocol.release("insertion"))
    script.run(script.protocol.release("rotation"))
    assert script.sent == [
        *("STA", "MG _BGA", "MG _BGA", "MOA"),
        *("STC", "MG _BGC", "MOC", "HX1"),
    ]


def test_both_axes_on_one_channel() -> None:
    with pytest.raises(UserError, match="galil_insertion_channel and galil_rotation_channel"):
        Script(galil_insertion_channel="C")
