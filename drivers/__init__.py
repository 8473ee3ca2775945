"""Drive arms: the `Arm` contract and one package per fieldbus, independent of identification."""
