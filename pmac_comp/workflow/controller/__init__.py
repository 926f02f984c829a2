"""A compensation on a controller: planned, uploaded, compared, kept, taken off again.

The way of a compensation on a controller, and the modules of each part of it::

    who is there   inspect doctor owners motion_owners
    its settings   commissioning safekeeping
    before it      upload_plan difference law_rows standing sign_test
    on it          upload_flow deploy
    off it again   removal
"""
