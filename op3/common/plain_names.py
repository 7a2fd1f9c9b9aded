"""Names of joints, effects and parameters in plain words."""

_WORDS = {"l": "left", "r": "right", "p": "P", "d": "D", "sho": "shoulder", "el": "elbow", "ank": "ankle", "com": "CoM",
          "dte": "DTE", "imu": "IMU", "lugre": "LuGre"}  # fmt: skip


def words(name: str) -> str:
    """A name in plain words: ``l_wrist`` becomes ``left wrist``."""
    name, _, joint = name.partition("@joint=")
    parts = name.replace("@", " at ").split("_")
    spoken = " ".join(_WORDS.get(part, part) for part in parts)
    return f"{spoken} of the {words(joint)}" if joint else spoken
