"""work on several processes or a cluster, with results kept between runs."""
