// The numbers behind the plots at the frame that is shown, made once an episode and filled at every frame.

import { element } from "./guide.js";

const PLACES = { reach: "from the hand", goal: "from its goal", moved: "moved", height: "higher" };

export class Readout {
  constructor(holder) {
    Object.assign(this, { holder, cells: [] });
  }

  // episode: as the server describes it. colours: by object, as in the plots.
  show(episode, colours) {
    this.cells = [];
    const row = (name, colour, values) => {
      const item = element("li");
      const label = item.appendChild(element("b", name));
      if (colour) label.style.setProperty("color", colour);
      for (const [text, key, list, unit] of values) {
        const value = element("output", "", { "data-of": name, "data-value": key });
        item.append(` ${text} `, value, unit);
        this.cells.push([value, list]);
      }
      return item;
    };
    const places = Object.entries(episode.places);
    this.holder.replaceChildren(
      row("hand", "", [
        ["", "speed", episode.eef_speed, " m/s"],
        ...Object.entries(episode.gripper).map(([name, list]) => ["gripper", name, list, ""]),
      ]),
      ...places.map(([name, place]) => row(name, colours(name), [
        ...(episode.object_speed[name] ? [["", "speed", episode.object_speed[name], " m/s"]] : []),
        ...Object.entries(PLACES).filter(([key]) => place[key]).map(([key, text]) => [text, key, place[key], " m"]),
      ])),
    );
  }

  at(step) {
    this.holder.dataset.step = step;
    for (const [value, list] of this.cells) value.textContent = list[step].toFixed(3);
  }
}
