"""Before and after on fresh runs that alternate, and learning from them."""
