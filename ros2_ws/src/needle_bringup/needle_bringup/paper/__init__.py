"""Every figure and number of [KC09] section IV, the paper's value beside ours."""
