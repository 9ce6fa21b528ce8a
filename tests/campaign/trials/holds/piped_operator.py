"""The operator, with the pipe of a trial's pedal in place of an event device."""

from __future__ import annotations

import sys

from campaign.trials.holds.piped_pedal import PipeDevice
from needle_bringup.ros import operator

if __name__ == "__main__":
    sys.exit(operator.main(PipeDevice))
