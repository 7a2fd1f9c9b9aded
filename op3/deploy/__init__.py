"""The robot's bus: packets and registers of Dynamixel Protocol 2.0, and an emulated robot that speaks them."""
