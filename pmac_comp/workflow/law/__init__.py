"""The dynamic law and the static map of a drive, in SI and in counts, and what the law costs.

The way from a model to what a controller evaluates, and the modules of each part of it::

    the routes     routes
    by time        dynamic_law
    by place       static_map backlash
    beyond models  beyond_model rippling drive_lag swinging_bed loose_nut
    in counts      rendering
    on the card    law_cost
"""
