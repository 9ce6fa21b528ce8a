"""What a recorded run says, straight from its bag."""
