"""Changes of several parts as a whole: grouped, waited for, recovered, rolled back, saved."""
