"""From simulation to the robot and back: returns, re-identification from failed transfers, and success."""
