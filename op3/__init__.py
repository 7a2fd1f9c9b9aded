"""Compliant balancing and walking for humanoids with gear-driven servos, from simulation to reality."""

import warnings

# dm_control tries GLFW first and falls back to EGL; on a machine without a screen the attempt is no news.
warnings.filterwarnings("ignore", message=".*DISPLAY environment variable is missing.*")
