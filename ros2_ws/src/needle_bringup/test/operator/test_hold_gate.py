"""Which press counts: by scenes, and by a rule that looks back from each moment."""

from hypothesis import given, settings
from hypothesis import strategies as st

from needle_bringup.operator.hand import Hand, Lost, Reading
from needle_bringup.operator.hold_gate import LONGEST_GAP, Held, HoldGate

CYCLE = 0.02
INSERT, RETRACT, NEUTRAL = Hand(insert=True), Hand(retract=True), Hand()
WANTS = {INSERT: Held.INSERT, RETRACT: Held.RETRACT}
READINGS = (
    NEUTRAL,
    INSERT,
    RETRACT,
    Hand(insert=True, retract=True),
    Hand(stop=True),
    Hand(insert=True, stop=True),
    Lost("unplugged"),
)
moments = st.tuples(st.sampled_from(READINGS), st.sampled_from((CYCLE, CYCLE, CYCLE, 0.15)))


def held(gate: HoldGate, *readings: Reading) -> list[Held]:
    return [gate.take(reading, CYCLE * number).held for number, reading in enumerate(readings)]


def counts(seen: list[tuple[Reading, float]]) -> Held:
    """Return what may be held at the last moment, looking back: itself alone, since neutral."""
    last = seen[-1][0]
    for reading, gap in reversed(seen):
        if reading == NEUTRAL:
            return WANTS.get(last, Held.NOTHING)  # type: ignore[arg-type]
        if reading != last or last not in WANTS or gap > LONGEST_GAP:
            break
    return Held.NOTHING


@settings(max_examples=300, deadline=None)
@given(st.lists(moments, min_size=1, max_size=30))
def test_only_a_fresh_press_out_of_neutral_counts_and_as_long_as_it_lasts(
    seen: list[tuple[Reading, float]],
) -> None:
    gate, now = HoldGate(), 0.0
    for number, (reading, gap) in enumerate(seen):
        now += gap
        grip = gate.take(reading, now)
        # Before the first look there is no gap.
        back = [(what, 0.0 if at == 0 else before) for at, (what, before) in enumerate(seen)]
        assert grip.held is counts(back[: number + 1])
        assert bool(grip.trouble) is isinstance(reading, Lost)


def test_a_press_after_a_loss_counts_only_out_of_neutral() -> None:
    gate = HoldGate()
    assert held(gate, NEUTRAL, INSERT, Lost("gone"), INSERT, INSERT, NEUTRAL, INSERT) == [
        Held.NOTHING,
        Held.INSERT,
        *[Held.NOTHING] * 4,
        Held.INSERT,
    ]


def test_a_stop_is_asked_for_once_a_press_and_ends_what_is_held() -> None:
    gate = HoldGate()
    both = Hand(insert=True, stop=True)
    grips = [
        gate.take(reading, CYCLE * number)
        for number, reading in enumerate(
            (NEUTRAL, INSERT, both, both, INSERT, NEUTRAL, Hand(stop=True))
        )
    ]
    assert [grip.stop for grip in grips] == [False, False, True, False, False, False, True]
    assert [grip.held is Held.INSERT for grip in grips] == [False, True, *[False] * 5]


def test_who_stands_still_begins_anew() -> None:
    gate = HoldGate()
    gate.take(NEUTRAL, 0.0)
    assert gate.take(INSERT, 0.02).held is Held.INSERT
    assert gate.take(INSERT, 0.02 + 0.99 * LONGEST_GAP).held is Held.INSERT
    frozen = gate.take(INSERT, 0.02 + 2.01 * LONGEST_GAP)
    assert frozen.held is Held.NOTHING
    assert frozen.unheeded


def test_the_speed_is_the_hands_of_now() -> None:
    gate = HoldGate()
    gate.take(NEUTRAL, 0.0)
    for number, speed in enumerate((0.2, 0.0, 1.0), start=1):
        assert gate.take(Hand(insert=True, speed=speed), CYCLE * number).speed == speed
