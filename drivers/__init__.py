"""Drive arms: the Arm contract and one package per fieldbus; nothing here knows of identification."""
