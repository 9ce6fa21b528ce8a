"""The operator, with the pipe of a trial's pedal in place of an event device."""

from __future__ import annotations

import sys

from needle_bringup.ros import operator
from needle_verification.trials.piped_pedal import PipeDevice

if __name__ == "__main__":
    sys.exit(operator.main(PipeDevice))
