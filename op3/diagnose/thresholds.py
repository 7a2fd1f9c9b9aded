"""Thresholds of the decision, each with where it comes from."""

SMALLEST_GAIN = 0.05
"""Share of the residual (mean of fitted and choosing runs) that an effect must explain to count. Six empty development
legs gave up to 0.04 beyond the other two rules below."""

DOUBLY_CHECKED = 0.08
"""What explains less than this counts only if free runs do not speak against it. On an empty leg an asymmetry of
friction explained 0.05 of windows, and free runs were worse with it; a true zero error of an encoder that they did not
bear either explained 0.09."""

BEYOND_DOUBT = 4.9
"""Statistic of the gain and score of its ranks, both, from which on free runs are not asked. A true quadratic drag that
explained 0.07 had 5.0 and 5.2; on 24 empty legs the smaller of the two was 4.8 once, of static friction that explained
0.03 and so did not count, and else 3.7 at most."""

OWN_CLEAR, OWN_CLEAR_Z = 0.35, 2.0
"""Share of its joint's residual, in fitted and choosing runs, from which on the fault of a joint needs only this of the
ranks; between `OWN_GAIN` and this the score falls linearly from `OWN_Z`. A terminal resistance acts where a servo is at
its voltage, and elsewhere not at all. Beside a sagging supply it explained 0.64 and 0.44 of its joint."""

OWN_CHECKED = 0.25
"""What explains less of its own joint than this, and of all joints less than `SMALLEST_GAIN`, counts only if free runs
of that joint do not speak against it either. With twenty joints one may look faulty by chance: an elbow of an empty
robot had 0.15."""

SMALLEST_T = 3.0
"""Gain over its standard error, seconds being independent, that an effect must reach. A few odd windows give a large
gain with a t of 1 to 2; empty development legs reached 2.9 at a gain of 0.04."""

SMALLEST_Z = 3.0
"""Standard score of the gains' signed ranks that will do in place of t, if both the fitted and the choosing runs gain
`SMALLEST_GAIN`: a few windows with large residuals spoil the t of an effect that helps nearly everywhere. A true zero
error of a current sensor had 3.8 at a t of 1.3; the leaders of two empty legs had 1.8 and 2.0."""

CLEAR_GAIN, CLEAR_T, CLEAR_TRIMMED = 0.15, 2.0, 0.08
"""Gain of an effect that may count at a smaller t, if it is not that of a few seconds and the choosing runs show half
of it. Of two strong effects hidden together the first gave a gain of 0.17 at a t of 2.3, because in some seconds the
other one makes the model wrong. The largest gain in six empty legs was 0.09."""

LATER_GAIN, LATER_TRIMMED = 0.02, 0.01
"""Gain of a further effect that counts where t and the score of the ranks both reach their thresholds: one of a single
joint, beside one of all, has a small share of what is left. A true asymmetry of friction in one joint had 4.4 and 5.1
at a gain of 0.024, beside a lag of the current loop. Where nothing further was hidden the smaller of the two reached
2.5 in 23 development legs, at a gain of up to 0.11. Of an effect of all joints this holds only above `SHARED_ROOM`:
five robots without static friction seemed to have some behind the one effect that was hidden (0.02 to 0.04, t of 3.6 to
4.9), while all that was left was 0.9 to 1.1 times the noise; a true one behind bristles explained 0.03 of 2.3 times."""

RESIDUE = 0.05
"""Share of what an earlier effect explained that a further one must explain where the catalogue says that they may be
confused: no law is quite the robot's, and what is left of one looks like its confounders. Of a false mass of a link,
which explained 0.83, an encoder's zero seemed to be left (0.03)."""

SHARED_RESIDUE = 0.03
"""The same of any two effects that all joints share: what one leaves in all joints, another seems to explain. Behind a
strong latency (0.92, 0.96) load_friction seemed to explain 0.023 and 0.004 of what that did; in true pairs of shared
effects the second had at least 0.057."""

BEHIND, BEHIND_GAIN = {"current_lag": "latency"}, 0.04
"""Effects of all joints that another stands for where they are not in the model, and the share of what that one leaves,
in fitted and choosing runs, from which on they are no residue of its law: behind latencies that were hidden with a lag
of the current loop, and explained 0.93 to 0.98, the lag explained 0.61 and 0.34 of the rest, a moderate one 0.045 and
0.085. Behind seven that were hidden alone it explained less than 0.03."""

LATER_Z = 4.0
"""Score of the ranks that will do in place of t for a further effect if fitted and choosing runs both gain
`LATER_GAIN`. A true asymmetry of friction had 4.5 at a t of 1.4, beside a sensor's zero in another joint; where nothing
further was hidden it reached 3.0."""

OWN_GAIN, OWN_T, OWN_Z, OWN_TOTAL_T = 0.08, 2.0, 4.0, 1.0
"""What a fault of one joint may explain instead, of the residuals of this joint alone, in fitted and choosing runs, if
the whole has not become worse: the other joints' residuals, which it leaves as they are, hide it. A true asymmetry of
friction that explained 0.03 of all explained 0.19 of its joint's (t 3.9, score of the ranks 5.5), a friction that
depends on the angle 0.19 (2.3, 4.5). On five empty legs the leaders explained at most 0.01 in both (score 2.6)."""

FIRM_OWN_T, FIRM_OWN_Z = 3.0, 2.5
"""The same of what is not of friction behind another effect: more of t, and less of the ranks where it explains
`OWN_GAIN`. A centre of mass that was hidden with a false mass explained 0.19 and 0.11 of its joint with 3.5 and 2.7.
Behind 45 effects that were hidden alone none that was not there explained more than 0.043 of its joint in both."""

FURTHER_Z = 2.5
"""Score of the ranks that a further effect must reach in any case, if it explains `SMALLEST_GAIN`; of one that explains
less `SMALLEST_Z` is asked. Behind the one effect that was hidden in 17 legs, what explained that much had t of 1.7 at
most."""

OCCASIONAL = ("packet_drop",)
"""Effects that act in few seconds, each of which tells by itself: behind others too they need not reach a score of the
ranks if they explain `SMALLEST_GAIN`. Lost packets beside a lag of the current loop explained 0.28 of what that left
with a t of 3.4, the ranks 1.7."""

LIMITED, LIMITED_GAIN = ("voltage_sag",), 0.06
"""Effects of all joints that act only where servos are at their voltage, so that t and ranks over all seconds tell
little, and the share of the residual from which on they count at a t of `CLEAR_T`, fitted and choosing runs each having
half of it. Moderate sags that were hidden explained 0.07 to 0.12; where none was, 0.05 at most in some hundred legs,
and 0.013 in 36 sound ones."""

FIRM = (
    *("encoder_offset", "encoder_nonlinearity", "link_mass", "link_com", "link_inertia", "payload", "com_offset"),
    *("cable_spring", "current_offset", "torque_constant", "terminal_resistance", "voltage_sag", "latency"),
    *("current_lag", "velocity_filter", "packet_drop"),
)
"""Effects that are not of friction. What a law of friction gets wrong, as every law does, looks like other friction:
static friction explained 0.02 and 0.03 of an empty leg, with a t of 4.1. It does not look like these."""

FIRM_GAIN, FIRM_TRIMMED = 0.016, 0.01
"""Share of the residual that such an effect must explain, in fitted and choosing runs each, if t and the score of its
ranks both reach their thresholds. Zero errors of encoders, a centre of mass and non-linear encoders that were hidden
explained 0.02 to 0.04 at a t of 3.1 to 3.3 (ranks 2.6 to 3.5); on 36 empty legs none of these effects explained more
than 0.010 in both at a t above 2."""

TRIMMED = 3
"""Seconds with the largest gain that are left out for the next rule."""

TRIMMED_GAIN = 0.02
"""Share of the residual that must still be explained without them: an effect acts in more than a few seconds."""

LARGE_GAP = 4.0
"""Residual velocity of a joint, in standard deviations of a reading (root mean square over windows of 0.2 s), beyond
which something is missing whatever the catalogue says, if the joint also stands out by `OUTSTANDING`. In five
development legs joints in which nothing was hidden had 0.8 to 2.9, one with a strong sticky patch 5.4."""

OUTSTANDING = 2.5
"""How many times the median of all joints that is: model errors are shared by joints of one make. Empty development
legs gave up to 1.7, strong outsiders 4 and more."""

ROOM = 2.0
"""Residual velocity, in standard deviations of a reading, up to which a joint leaves no room for a further effect."""

SHARED_ROOM = 1.5
"""The same for an effect of all joints, of most of them. Behind one of 45 effects that were hidden alone a small one of
all joints seemed to be there (0.04, t 4.4), where 0.9 was left; a static friction that was hidden behind bristles
explained 0.04 of 1.9."""

STANDING = 1.8
"""How many times the median of all joints the residual velocity of one is that leaves room for a further effect. Where
one effect was hidden the leader left up to 1.5 times, impacts aside; beside a cable's spring that was hidden too, 2.0
to 3."""

BESIDE_GAIN, BESIDE_SHARED_GAIN, BESIDE_Z = 0.1, 0.03, 2.5
"""Share of a joint's residual under the leader by which another effect there has to be better, in fitted and choosing
runs, for a further round; the same of an effect of all joints in those that the leader does not act in; and the score
of the ranks. Where one effect was hidden in a joint, none of all joints was better in the others at all."""

ANOTHER = 0.4
"""Share of what the leader explains that an effect must explain, both of all joints, beyond the square of the cosine
between the two, which one effect gives another for nothing: then they are two, and a further round follows. A lag of
the current loop that was hidden beside one of friction explained 0.85 of what that did at a cosine of 0.24; where one
effect was hidden, others that were not its confounders explained 0.12 of it at most."""

ALONG_THE_LIMB = "gravity_phase"
"""Alias class of effects that act in the other joints of a limb as well: they are confused from joint to joint."""

SMALLEST_SIZE = 0.7
"""Size below which an effect does not matter, as a share of the catalogue's smallest."""

RIVAL = 0.6
"""A rival that explains this share of what the best explains, and cannot be told from it, is a candidate too."""

NAMED_SHARE = 0.8
"""Share of bootstrap resamples that the best must win to be named alone."""

ALIKE_SHARE = 0.9
"""The same where the next best is of the same alias class, which explains nearly the same. Of twelve leaders that won
this share in development cases eleven were right."""

SURELY_ALIKE = 0.99
"""The same for its confidence not to be cut to `UNDECIDED`."""

PICKED = 0.3
"""Share of resamples in which a name has to be the best to be stated, unless it explains `CLEAR_GAIN`."""

UNDECIDED = 0.7
"""Most confidence that a candidate of an ambiguous verdict has: resampling tells what noise can do, not what a law that
is a little wrong does to effects that look alike. A sensor's zero won 99 % against the asymmetric friction that was
hidden."""

PARSIMONY = 0.1
"""Share of what the best explains that a hypothesis with fewer numbers may fall short of it and still be preferred: a
further number explains some of what any law gets wrong."""

PARSIMONY_T, PARSIMONY_Z = 2.5, 3.0
"""Gain of the best over it in standard errors, and score of its ranks, at which it is not, however little more the best
explains: what a law gets wrong does not tell in nearly every second."""

OF_A_MAKE = (
    *("dte", "stribeck", "lugre", "load_friction", "directional_friction", "antagonistic_friction", "quadratic_drag"),
    *("friction_drift",),
)
"""Laws of a gear and its grease, which servos of one make share. In one joint alone such a name has `UNDECIDED` at
most. That is a prior: what else may be wrong in a joint, a hard stop, a vibration, an encoder, looks like one of these,
and a servo that follows another law than others of its make is rare. Four of seven names that were wrong and stated
with more than 0.8 in 320 legs were of this kind; how often a right one is, these legs do not tell: none hid any."""

SHORT = {"latency": "current_time_constant"}
"""Effects whose names have `UNDECIDED` at most where they are no larger than what a base takes for granted of this part
of the chain of measurement, see `op3.diagnose.coordinates.chain_limit`. Behind another effect a lag of 2.8 ms was told
as a delay of 1.4 ms."""

PREFERRED = 0.7
"""Confidence at most in what was preferred so to another that counts and wins more of the resamples. A non-linear
encoder that was hidden behind a viscous joint was taken for a zero error, which has one number less and explained 0.097
for 0.103."""

RESAMPLES = 1000
"""Bootstrap resamples over blocks of a second."""

CONTACTS = ("backlash",)
"""Effects with free flight and impacts, in which small errors of the start grow: what the right one leaves is large as
well."""

EXPLAINED_CONTACT = 0.2
"""What such an effect must explain of the gap in the joint that stands out, in place of `EXPLAINED`; it then counts
without the t. A true backlash explained 0.46 where nothing else explained 0.02, one of a light foot, whose rattling is
soon a matter of chance, 0.25. Where an obstacle, a fixed frequency, or a chipped tooth was hidden, the best of all
effects explained 0.11 at most."""

EXPLAINED = 0.5
"""Share of the reducible gap, or of what a black box explains, that the best of the catalogue must explain; below it
the verdict is unknown."""

CEILING = 0.12
"""Share of the residual that a black box must explain on the choosing runs for something to be missing. On empty legs
it explains nothing on runs that it has not seen."""

CONCENTRATED = 0.6
"""Share of what the black box explains that one joint must carry: a law of friction that is a little wrong shows
in all joints. An empty development leg with little friction gave 0.39 (of 32 % explained), local outsiders 0.9."""

LOOK_ALIKE = 0.7
"""Cosine beyond which two effects look alike to the logs, so that a name needs more certainty."""

MOST_CANDIDATES = 3
"""Candidates that an ambiguous verdict lists."""
