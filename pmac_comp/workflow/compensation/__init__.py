"""From a model and captures to a compensation: computed, written, drawn for its route, promised.

The way of a compensation, and the modules of each part of it::

    computed       compensate foreseen computing
    kept           file text
    in counts      tables cam program repeated
    promised       promises
"""
