"""From captures to a model: identified, diagnosed, compared with rivals, used to predict."""
