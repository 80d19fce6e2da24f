"""The study of the paper's claims: which networks it trains (`runs`), what is measured of them
(`records`), what that says of the claims (`claims`), stage by stage (`stages`)."""
