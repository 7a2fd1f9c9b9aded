"""Feet and floor."""

from collections.abc import Mapping

from torch import Tensor

from op3.servo.effect import Effect, ModelEdit, Parameter, Stage, register
from op3.servo.effects.trunk import about, product
from op3.servo.signals import Trunk


@register
class FootFriction(Effect):
    """Relative error of the sliding friction between feet and ground, written to the geoms of both."""

    name = "foot_friction"
    stage = Stage.GROUND
    equation = "mu *= 1 + e"
    source = "aluminium and rubber soles on floors; range chosen by us"
    parameters = (
        Parameter("foot_friction_error", "-", -0.65, 0.4, 0.0, 0.0, "e, relative", per_joint=False, least=-0.99),
    )
    edits = (ModelEdit("geom_friction", "ground_geom", "scale", "foot_friction_error", column=0),)
    secants = ({"foot_friction_error": -0.2}, {"foot_friction_error": -0.5})
    fingerprint = "only in stance: the foot slips, so its pose drifts"
    confounders = ("foot_compliance", "ground_tilt")
    separating_experiment = "force at which a foot slides over the floor, measured with a spring balance"


@register
class FootCompliance(Effect):
    """Softer contact between feet and ground, as the time constant of the contact."""

    name = "foot_compliance"
    stage = Stage.GROUND
    equation = "T_contact += dT"
    source = "MuJoCo solref, 20 ms by default; contact stiffness falls with its square; range chosen by us"
    parameters = (Parameter("contact_time_added", "s", 0.0, 0.02, 0.0, 0.0, "dT", per_joint=False, least=0.0),)
    edits = (ModelEdit("geom_solref", "ground_geom", "add", "contact_time_added", column=0),)
    secants = ({"contact_time_added": 0.004}, {"contact_time_added": 0.012})
    fingerprint = "only in stance: a changed impact peak and settling time"
    confounders = ("compliance", "latency", "foot_friction")
    separating_experiment = "drop of the robot by one centimetre with its legs held rigid"


@register
class GroundTilt(Effect):
    """The floor, or the stand, is tilted: R_floor = Ry(pitch) Rx(roll).

    The scene is unchanged and gravity is rotated, so the robot starts flush with the floor; its IMU measures relative
    to gravity and shows the tilt.
    """

    name = "ground_tilt"
    stage = Stage.GROUND
    equation = "g = R_floor' g_0, R_measured = R_floor R"
    source = "rigid motion; range of 3 degrees chosen by us"
    parameters = (
        Parameter("ground_roll", "rad", -0.05, 0.05, 0.0, 0.0, "about the x axis of the scene", per_joint=False),
        Parameter("ground_pitch", "rad", -0.05, 0.05, 0.0, 0.0, "about the y axis of the scene", per_joint=False),
    )
    edits = (
        ModelEdit("opt.gravity", "option", "turn", "ground_pitch", column=1),
        ModelEdit("opt.gravity", "option", "turn", "ground_roll", column=0),
    )
    secants = ({"ground_roll": 0.02}, {"ground_pitch": 0.02})
    fingerprint = "a bias of roll, pitch and all gravity torques, only on this floor"
    confounders = ("imu_mount", "com_offset", "left_right_asymmetry", "encoder_offset")
    separating_experiment = "recordings before and after turning the robot by 180 degrees about the vertical"

    def sense_trunk(self, trunk: Trunk, values: Mapping[str, Tensor]) -> None:
        floor = product(about(1, values["ground_pitch"]), about(0, values["ground_roll"]))
        trunk.quaternion = product(floor, trunk.quaternion)
