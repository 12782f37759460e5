"""Deep Compliant Control (Lee, Chang and Lee, SIGGRAPH 2022): its scenes and its imitation controller.

The law itself, `control.compliance`, and goals that give way by it, `env.yielding`, are the engine's.
"""
