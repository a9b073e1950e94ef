// 3D views are drawn before the columns beside them stand: once all is there, they take the width that is left.
window.addEventListener("load", () => window.dispatchEvent(new Event("resize")));
