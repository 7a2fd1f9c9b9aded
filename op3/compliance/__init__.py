"""How soft a robot is under a policy: measured on its joints, its landings, pushes and pulls, and never inferred."""
