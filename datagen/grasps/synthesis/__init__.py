"""Grasps simulated with MuJoCo for any MANO-format hand and any object."""
