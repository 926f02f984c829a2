"""Compensation in SI: dynamic law, lead table, pre-compensated trajectory, limits. No counts.

The way from a model and captures to what is sent, and the modules of each part of it::

    the drive      loop motions delay
    the law        law evaluation resting
    its fit        free judgement design search
    by captures    starts grip creep ripple constant trim clearance
    by place       lead wobble
    one motion     exact
    promised       promise unmodelled
"""
