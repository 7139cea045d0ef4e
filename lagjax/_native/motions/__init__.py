"""Whole motions, their derivatives, and their launchers: on threads, from XLA, on GPUs.

_integrator        the loop over steps of a motion
_maps              the maps that a step is composed of, each with its pushforward and its pullback
_recorded_steps    recorded steps replayed;  _tangent, _adjoint: derivatives over them
_kernel            motions and derivatives as functions of arrays;  _threads: on several cores, interruptible
_handler           the motion as a call of XLA;  _derivative_handler: derivatives of short motions
_line_handler      any straight line as a call of XLA;  _c_lines: the same line as text in C
_gpu               the modules of one lane as programs for NVIDIA GPUs;  _gpu_entry: the entry of a GPU thread
"""
