"""Learned rivals and a learned controller: an amortised posterior, a predictive network, a car-following policy."""
