"""The Acme G2, an invented gripper: a dexkit backend and an emulated device to try it on."""
