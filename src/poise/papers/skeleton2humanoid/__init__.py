"""Skeleton2Humanoid (Li et al., ACM MM 2022): its third stage, a policy for a set of motions.

The stages before are the engine's: filling between keyframes (`jobs.inbetween`), test-time adaptation
(`learn.inbetween_model`) and analytic inverse kinematics (`kinematics.ik`).
"""
