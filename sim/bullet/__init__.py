"""The physics engine (pybullet): its client, multibodies by joint and link name, and their URDF text."""
