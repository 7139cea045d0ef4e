"""Whole motions, forward and back, and their launchers: on threads, from XLA, on GPUs.

_integrator        the pieces of a step, round by round
_maps              what a step is composed of, each map with its pushforward and its pullback
_recorded_steps    recorded steps once more;  _tangent, _adjoint: their maps forward and back
_kernel            motions and derivatives as functions of arrays;  _threads: on several cores, interruptible
_handler           the motion as a call of XLA;  _derivative_handler: derivatives of short motions
_line_handler      any straight line as a call of XLA;  _c_lines: the same line as text in C
_gpu               the modules of one lane as programs for NVIDIA GPUs;  _gpu_entry: what a thread of these does
"""
