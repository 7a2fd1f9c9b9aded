"""Masses, centres of mass and inertias beyond the robot's model."""

from op3.servo.effect import Effect, ModelEdit, Parameter, Stage, Usual, register


@register
class Payload(Effect):
    """Mass added to the base link at its centre of mass.

    The public model has 3.147 kg, but the specification states about 3.5 kg; battery, cables and screws explain this.
    """

    name = "payload"
    stage = Stage.BODY
    equation = "m_base += dm"
    source = "paper Table I, base mass offset"
    parameters = (Parameter("base_mass_offset", "kg", 0.0, 0.5, 0.25, 0.0, "added to the base link", per_joint=False),)
    edits = (ModelEdit("body_mass", "base_body", "add", "base_mass_offset"),)
    secants = ({"base_mass_offset": 0.1},)
    fingerprint = "in phase with gravity, in a fixed ratio in all joints that carry the base; may differ by recording"
    confounders = ("com_offset", "link_mass", "torque_constant")
    separating_experiment = "recordings with and without a known added mass, and in two orientations of the base"


@register
class CentreOfMassOffset(Effect):
    """Shift of the base link's centre of mass, forwards and upwards."""

    name = "com_offset"
    stage = Stage.BODY
    equation = "c_base += (dx, 0, dz)"
    source = "paper Table I, base CoM offset x and z"
    parameters = (
        Parameter("base_com_offset_x", "m", -0.02, 0.02, 0.0, 0.0, "forwards", per_joint=False),
        Parameter("base_com_offset_z", "m", -0.02, 0.02, 0.0, 0.0, "upwards", per_joint=False),
    )
    edits = (
        ModelEdit("body_ipos", "base_body", "add", "base_com_offset_x", column=0),
        ModelEdit("body_ipos", "base_body", "add", "base_com_offset_z", column=2),
    )
    secants = ({"base_com_offset_x": 0.005}, {"base_com_offset_z": 0.005})
    fingerprint = "in phase with the base link's gravity torque, with a direction that changes with the pose"
    confounders = ("payload", "encoder_offset", "cable_spring", "imu_mount", "ground_tilt")
    separating_experiment = "two orientations of the base: gravity turns with it, a spring does not; a known added mass"


@register
class LinkInertia(Effect):
    """Inertia of the moved link about its own centre of mass, beyond its model.

    On a bench whose weight is modelled as a point, this is the weight's own: ``m k^2`` with its radius of gyration k.
    """

    name = "link_inertia"
    stage = Stage.BODY
    equation = "J_link += m_link k^2"
    source = "rigid body; a disc of radius r about its axis has k^2 = r^2 / 2; the range covers discs of up to 0.16 m"
    parameters = (Parameter("gyration_squared", "m^2", 0.0, 0.0125, 0.0, 0.0, "squared radius of gyration added, k^2"),)
    # no weight is a point: the most compact, a steel ball of 0.2 to 1 kg, has k^2 = 2/5 r^2 = 1.3e-4 to 3.9e-4 m^2;
    # discs, screws and the arm add to it. With a single weight it is not distinguishable from the rotor's inertia
    usual = {"gyration_squared": Usual(2.5e-4, 1.5e-4, 2e-4, 1.5e-3, least=0.0, bench=True)}
    edits = (ModelEdit("body_inertia", "joint_body", "add", "gyration_squared", per="body_mass"),)
    secants = ({"gyration_squared": 2e-3},)
    fingerprint = "proportional to acceleration, in the joint and in the joints that carry it"
    confounders = ("motor", "torque_constant")
    separating_experiment = "fast motion of a neighbouring joint: link inertia couples joints, rotor inertia does not"


@register
class LinkMass(Effect):
    """Mass added to the moved link at its centre of mass: screws, cables, a payload at hand or foot."""

    name = "link_mass"
    stage = Stage.BODY
    equation = "m_link += dm"
    source = "CAD models omit screws and cables; range chosen by us"
    parameters = (Parameter("link_mass_offset", "kg", -0.01, 0.3, 0.0, 0.0, "added to the moved link", least=-0.011),)
    edits = (ModelEdit("body_mass", "joint_body", "add", "link_mass_offset"),)
    secants = ({"link_mass_offset": 0.02}, {"link_mass_offset": 0.1})
    fingerprint = "in phase with gravity, with a fixed ratio over all joints that carry the link"
    confounders = ("payload", "link_com", "torque_constant", "encoder_offset")
    separating_experiment = "recordings with and without a known added mass, and in two orientations of the base"
    scopes = ("joint",)


@register
class LinkCentreOfMass(Effect):
    """Shift of the moved link's centre of mass, in the frame of the link."""

    name = "link_com"
    stage = Stage.BODY
    equation = "c_link += (dx, dy, dz)"
    source = "CAD models omit screws and cables; range chosen by us"
    parameters = (
        Parameter("link_com_offset_x", "m", -0.02, 0.02, 0.0, 0.0, "forwards in the stand pose with straight legs"),
        Parameter("link_com_offset_y", "m", -0.02, 0.02, 0.0, 0.0, "to the left"),
        Parameter("link_com_offset_z", "m", -0.02, 0.02, 0.0, 0.0, "upwards"),
    )
    edits = tuple(
        ModelEdit("body_ipos", "joint_body", "add", f"link_com_offset_{axis}", column=column)
        for column, axis in enumerate("xyz")
    )
    secants = ({"link_com_offset_x": 0.005}, {"link_com_offset_y": 0.005}, {"link_com_offset_z": 0.005})
    fingerprint = "in phase with gravity, with a phase that turns with the pose, in all joints that carry the link"
    confounders = ("encoder_offset", "link_mass", "cable_spring", "current_offset")
    separating_experiment = "two orientations of the base: gravity turns with it, a spring does not; IMU and kinematics"
    scopes = ("joint",)
