"""One conversation done right: deadlines, resynchronisation, retry of reads only."""
