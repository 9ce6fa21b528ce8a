"""Galil protocol against scripted bytes: set-up, orders, states, and lost or refused replies."""

from __future__ import annotations

from typing import Any

import pytest

from needle_core.errors import UserError
from needle_device_driver.axes.link import DriveError
from needle_device_driver.backends.galil import GalilProtocol
from needle_device_driver.polled.drive_protocol import DriveReply

from .protocol_bench import ProtocolBench

BEAT = "nsbeat=8"
PROGRAM = (
    "DL|#NSDOG|nsbeat=nsbeat-1|WT 10|JP #NSDOG,nsbeat>0|STAC|#NSSTOP|WT 2|JP #NSSTOP,(_BGA+_BGC)>0"
    "|MOAC|#NSIDLE|WT 10|JP #NSIDLE|\\"
)
REQUEST = "MG 7,_TPA,_RPA,_TSA,_SCA,_TPC,_RPC,_TSC,_SCC,_XQ1,TIME"
STATE = "7.0000 {a} {c} {line}.0000 {time}.0000\r\n:"
REST = "0.0000 0.0000 44.0000 0.0000"


class Script(ProtocolBench[GalilProtocol]):
    """A controller that replies as scripted; by default it accepts all commands."""

    def __init__(self, **parameters: Any) -> None:
        super().__init__(GalilProtocol, **{"galil_rotation_channel": "C", **parameters})
        self.replies = {"\x12\x16": "DMC4143 Rev 1.3b\r\n:", "MG _CN0": "-1.0000\r\n:"}
        self.replies |= dict.fromkeys(("MG _BGA", "MG _BGC"), " 0.0000\r\n:")
        self.replies |= {"MG _XQ1": "-1.0000\r\n:", PROGRAM: "::"}
        self.commands: list[str] = []

    def pop_commands(self, sent: bytes | None = None) -> list[str]:
        """Return the commands in sent bytes; | is a line end in a download."""
        data = (self.sent() if sent is None else sent).decode()
        program, backslash, rest = data.partition("\\")
        commands = (rest if backslash else data).replace(";", "\r").split("\r")[:-1]
        return [program.replace("\r", "|") + "\\"] * bool(backslash) + commands

    def receive_text(self, text: str) -> None:
        self.receive(text.encode("latin-1"))

    def reply(self, sent: bytes) -> None:
        for command in self.pop_commands(sent):
            self.commands += [command] * (command != BEAT)
            self.receive_text(self.replies.get(command, ":"))

    def ready(self) -> Script:
        self.set_up()
        self.commands.clear()
        return self

    def answered(self, a: str = REST, c: str = REST, line: int = 1, time: int = 100) -> DriveReply:
        """Request the state, answer, and return the state of the insertion axis."""
        self.protocol.request(7)
        self.pop_commands()
        self.receive_text(STATE.format(a=a, c=c, line=line, time=time))
        assert self.states[-1][0] == 7
        return self.state()


def test_the_set_up_moves_nothing_and_the_last_axis_starts_the_watchdog() -> None:
    script = Script()
    assert script.run(script.protocol.identify()) == "DMC4143 Rev 1.3b"
    script.set_up()
    script.run(script.protocol.write_limits("rotation", -70, 80))
    # Ramps of 0.05 and 0.5 m/s^2, and 20 and 100 rad/s^2, in steps of 1024 counts/s^2.
    assert script.commands == [
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
        ({PROGRAM: "?::"}, r"refuses DL \(error .*: halt the controller's own program \(HX\)"),
        ({"XQ#NSDOG,1": "?"}, r"refuses XQ#NSDOG,1 \(error .* free its program memory"),
    ],
)
def test_a_refused_set_up_and_its_fix(replies: dict[str, str], message: str) -> None:
    script = Script()
    script.replies |= {"TC1": "6 Number out of range\r\n:", **replies}
    with pytest.raises(DriveError, match=message):
        script.ready()


def test_an_old_controller_needs_no_sd() -> None:
    script = Script()
    script.replies |= dict.fromkeys(("SDA=10000384", "SDC=1043456"), "?")
    assert not script.ready().answered().fault


@pytest.mark.parametrize(
    ("a", "expected"),
    [
        # Without a blank before the sign.
        ("-12.0000-13.0000 140.0000 0.0000", DriveReply(-12, True, True)),
        ("5.0000 5.0000 40.0000 3.0000", DriveReply(5, False, False, home_switch=True)),
        (
            "5.0000 5.0000 108.0000 8.0000",
            DriveReply(5, False, False, fault="exceeded its following error and switched off"),
        ),
    ],
)
def test_a_state(a: str, expected: DriveReply) -> None:
    script = Script().ready()
    script.answered("0.0000 0.0000 12.0000 0.0000")
    assert script.answered(a) == expected
    # A reversed axis has its outer switch at the forward end.
    reverse = Script(insertion_reverse=True).ready().answered(a)
    switches = reverse.inner_switch, reverse.home_switch
    assert switches == (expected.home_switch, expected.inner_switch)


@pytest.mark.parametrize(("reference", "speed"), [(-40, 2002), (-92, 2300), (-9000, 100_000)])
def test_a_lagging_axis_catches_up_within_two_cycles(reference: int, speed: int) -> None:
    script = Script(max_speed=0.005).ready()
    script.answered(f"0.0000 {reference}.0000 12.0000 0.0000")
    script.protocol.move_to("insertion", 0, 2001)
    assert script.pop_commands()[1] == f"SPA={speed}"


def test_a_limit_ends_position_tracking() -> None:
    script = Script().ready()
    script.protocol.move_to("insertion", 50, 100)
    script.receive_text(":::")
    script.answered("50.0000 50.0000 8.0000 3.0000")
    for position, orders in ((60, ["PTA=1", "SPA=900", "PAA=60"]), (70, ["SPA=900", "PAA=70"])):
        script.protocol.move_to("insertion", position, 900)
        assert script.pop_commands() == orders


def test_the_watchdog_shows_until_it_is_started_again() -> None:
    script = Script().ready()
    assert not script.answered(line=4).timed_out
    assert script.answered(line=5).timed_out
    script.run(script.protocol.clear_fault("insertion"))
    assert script.commands == []
    script.run(script.protocol.clear_fault("rotation"))
    assert script.commands[-1] == "XQ#NSDOG,1"


def test_a_refused_order_is_a_fault_with_its_reason() -> None:
    script = Script().ready()
    script.protocol.move_to("insertion", 1, 100)
    script.receive_text("::?")
    assert script.pop_commands()[-1] == "TC1"
    script.receive_text("20 Begin not valid with motor off\r\n:")
    fault = "refuses an order (error 20 Begin not valid with motor off)"
    assert script.answered().fault == fault
    script.run(script.protocol.clear_fault("insertion"))
    script.run(script.protocol.clear_fault("rotation"))
    assert not script.answered().fault
    # A controller may refuse MO while the axis moves.
    script.protocol.power("insertion", False)
    script.receive_text(":?")
    assert script.pop_commands() == ["STA", "MOA"]


@pytest.mark.parametrize(
    "before",
    [
        "",
        ":::::::",
        "?",
        "7.0000 1/0000 0.0000 44.0000\r\n:",
        # The rest of a garbled line is lost with it.
        "\xcd\xc7 \xba\r\n:",
        STATE.format(a=REST, c=REST, line=1, time=100).replace("7", "5", 1),
    ],
)
def test_a_state_restores_the_order_of_replies(before: str) -> None:
    """A beat and an order were sent before the request, and their replies are lost or wrong."""
    script = Script().ready()
    script.protocol.beat()
    script.protocol.stop("insertion")
    script.protocol.request(6)
    script.protocol.request(7)
    script.receive_text(before)
    for byte in STATE.format(a=REST, c=REST, line=1, time=100):
        script.receive_text(byte)
    assert [number for number, _ in script.states] == [7]
    assert (script.state().position, script.state("rotation").fault) == (0, "")
    # The next replies are matched again.
    script.pop_commands()
    script.protocol.move_to("rotation", 1, 2)
    script.receive_text("::?")
    assert script.pop_commands()[-1] == "TC1"


def test_both_axes_on_one_channel() -> None:
    with pytest.raises(UserError, match="galil_insertion_channel and galil_rotation_channel"):
        Script(galil_insertion_channel="C")
