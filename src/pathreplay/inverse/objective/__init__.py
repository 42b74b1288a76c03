"""The objective: the loss and its gradients as a function of the variables.

Each evaluation computes the contribution of some of the views.
"""
