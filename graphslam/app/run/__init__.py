"""From a log to a solved map: the pipeline, its settings, its folder and its metrics."""
