"""Step I: whatever a person holds, its hold ends with it, and nothing moves on by itself."""

from __future__ import annotations

from needle_verification.checking import Check

CHECKS: tuple[Check, ...] = ()
