// Rerun's viewer is a notebook's widget: it asks a model for its values. This one has them, and no kernel behind it.
import widget from "./widget.js";

const values = { _url: new URL("./recording.rrd", location).href, _width: "auto", _height: "auto", _theme: "light" };
const model = { get: (name) => values[name], on() {}, off() {}, send() {}, set() {}, save_changes() {} };
widget.render({ model, el: document.getElementById("view") });
