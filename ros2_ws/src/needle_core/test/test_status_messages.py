"""Key-value messages of device and controller, also malformed ones."""

from needle_core.status_messages import ControllerStatus, DeviceStatus


def test_a_malformed_value_keeps_its_default() -> None:
    keys = ("starts", "insertion_m", "depth_m", "target_point_m", "r1_low_m", "reachable_depth_m")
    for text in ("nan", "inf", "-inf", "two", "", "1, 2", "1e999", "1, x, 3"):
        assert ControllerStatus.parse(dict.fromkeys(keys, text)) == ControllerStatus()
        assert DeviceStatus.parse({"insertion_m": text}) == DeviceStatus()


def test_simulated_is_true_only_if_given() -> None:
    parsed = {one: DeviceStatus.parse({"simulated": one}).simulated for one in ("true", "", "yes")}
    assert parsed == {"true": True, "": None, "yes": False}


def test_unknown_keys_are_ignored() -> None:
    assert DeviceStatus.parse({"state": "MOVING", "text": "x", "colour": "blue"}) == DeviceStatus(
        state="MOVING"
    )
