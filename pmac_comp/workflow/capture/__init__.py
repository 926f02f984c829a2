"""An axis under a controller: connected, guarded, moved, and gathered into captures.

The way from an address to a capture, and the modules of each part of it::

    a card         simulated session context at_work
    as described   as_described card_law
    an axis        axis_setup axis
    its runs       sensors run_cut run_log samples
    captures       capturing
"""
