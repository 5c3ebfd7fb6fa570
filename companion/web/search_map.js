// Draws a moment of the flight on Leaflet. Without tiles the map is a plain grid in metres: x east,
// y north. With tiles the local metres are laid on the globe around the autopilot's origin.
import { leaflet as L } from "nicegui-leaflet";
import { loadResource } from "../../static/utils/resources.js";

const METRES_PER_DEGREE = 111319.49;
const COLOURS = {
  vehicle: "#1f4e79", estimate: "#d1495b", second: "#8e44ad", waypoint: "#b8860b",
  fence: "#2a9d3f", keepOut: "#7f1d1d", near: "#2a9d3f", far: "#d97706", truth: "#111111",
  other: "#d1495b", reported: "#1f4e79",
};

export default {
  template: '<div class="search-map"></div>',
  props: { scene: Object, hasTiles: Boolean, resourcePath: String },
  async mounted() {
    await this.$nextTick();
    await loadResource(window.path_prefix + `${this.resourcePath}/leaflet/leaflet.css`);
    this.origin = null;
    this.isFollowing = true;
    this.map = L.map(this.$el, {
      crs: this.hasTiles ? L.CRS.EPSG3857 : L.CRS.Simple,
      minZoom: this.hasTiles ? 2 : -4, maxZoom: this.hasTiles ? 23 : 7,
      zoomSnap: 0.25, attributionControl: false, preferCanvas: false,
    });
    this.map.setView([0, 0], this.hasTiles ? 17 : 2);
    if (this.hasTiles) {
      L.tileLayer(window.path_prefix + "/tiles/{z}/{x}/{y}.png",
        { maxZoom: 23, maxNativeZoom: 19 }).addTo(this.map);
    }
    this.grid = L.layerGroup().addTo(this.map);
    this.still = L.layerGroup().addTo(this.map);
    this.moving = L.layerGroup().addTo(this.map);
    L.control.scale({ imperial: false }).addTo(this.map);
    this.map.on("dragstart", () => { this.isFollowing = false; });
    this.map.on("moveend zoomend", () => this.drawGrid());
    new ResizeObserver(() => this.map && this.map.invalidateSize()).observe(this.$el);
    this.isReady = true;
    this.drawStill();
    this.fit(this.scene.fence || [[-50, -50], [50, 50]]);
    if (this.waiting) this.show(...this.waiting);
  },
  beforeUnmount() {
    if (this.map) this.map.remove();
    this.map = null;
  },
  methods: {
    at(point) {
      const [east, north] = point;
      if (!this.hasTiles) return [north, east];
      const [lat, lon] = this.origin || [0, 0];
      const scale = METRES_PER_DEGREE * Math.cos((lat * Math.PI) / 180);
      return [lat + north / METRES_PER_DEGREE, lon + east / scale];
    },
    line(points, style) { return L.polyline(points.map(this.at), { interactive: false, ...style }); },
    area(points, style) { return L.polygon(points.map(this.at), { interactive: false, ...style }); },
    dot(point, radius, style) {
      return L.circleMarker(this.at(point), { radius, interactive: false, weight: 2, ...style });
    },
    ring(centre, radiusM, style) {
      const points = [];
      for (let i = 0; i < 72; i += 1) {
        const turn = (2 * Math.PI * i) / 72;
        points.push([centre[0] + radiusM * Math.cos(turn), centre[1] + radiusM * Math.sin(turn)]);
      }
      return this.area(points, { fill: false, ...style });
    },
    fit(points) {
      if (this.map && points.length) this.map.fitBounds(points.map(this.at), { padding: [24, 24] });
    },
    fitAll() {
      this.isFollowing = true;
      this.fit(this.scene.fence || [[-50, -50], [50, 50]]);
    },
    drawStill() {
      this.still.clearLayers();
      const { fence, keep_out: keepOut, truth } = this.scene;
      if (fence) {
        this.still.addLayer(this.area(fence,
          { color: COLOURS.fence, weight: 2, dashArray: "6 4", fill: false, className: "fence" }));
      }
      for (const polygon of keepOut || []) {
        this.still.addLayer(this.area(polygon,
          { color: COLOURS.keepOut, weight: 1, fillOpacity: 0.25, className: "keep-out" }));
      }
      if (truth) {
        this.still.addLayer(this.dot(truth, 5, { color: COLOURS.truth, className: "truth" }));
      }
    },
    drawGrid() {
      if (!this.map || this.hasTiles) return;
      this.grid.clearLayers();
      const bounds = this.map.getBounds();
      const width = bounds.getEast() - bounds.getWest();
      let step = 1;
      for (const factor of [5, 2, 5, 2, 2.5, 2, 2]) if (width / step > 12) step *= factor;
      const style = { color: "#94a3b8", weight: 0.5, opacity: 0.7 };
      const [w, e, s, n] = [bounds.getWest(), bounds.getEast(), bounds.getSouth(), bounds.getNorth()];
      for (let x = Math.ceil(w / step) * step; x <= e; x += step) {
        this.grid.addLayer(this.line([[x, s], [x, n]], style));
      }
      for (let y = Math.ceil(s / step) * step; y <= n; y += step) {
        this.grid.addLayer(this.line([[w, y], [e, y]], style));
      }
    },
    show(picture, track) {
      if (!this.isReady || !this.map) { this.waiting = [picture, track]; return; }
      if (this.hasTiles && picture.origin && `${picture.origin}` !== `${this.origin}`) {
        this.origin = picture.origin;
        this.drawStill();
        this.fitAll();
      }
      this.moving.clearLayers();
      const add = (layer) => this.moving.addLayer(layer);
      for (const mark of picture.marks || []) this.drawMark(mark, picture, add);
      if (track.length > 1) add(this.line(track, { color: COLOURS.vehicle, weight: 2, opacity: 0.7 }));
      this.drawOthers(picture.emitters || [], add);
      this.drawEstimate(picture.estimate, add);
      this.drawPlan(picture, add);
      if (picture.vehicle) {
        add(this.dot(picture.vehicle, 7, {
          color: "#ffffff", fillColor: COLOURS.vehicle, fillOpacity: 1, className: "vehicle",
        }));
      }
    },
    drawMark(mark, picture, add) {
      const age = Math.max(0, picture.t_s - mark.t_s);
      const opacity = Math.max(0.08, 0.5 - age / 20);
      const weight = mark.range_weight === null ? 1 : mark.range_weight;
      const color = weight > 0.9 ? COLOURS.near : COLOURS.far;
      if (mark.range_m !== null) {
        add(this.ring(mark.sensor_enu_m, mark.range_m, { color, weight: 1, opacity, className: "range" }));
      }
      if (mark.bearing_enu_rad !== null) {
        const [east, north] = mark.sensor_enu_m;
        const reach = mark.range_m === null ? 100 : mark.range_m;
        const end = [east + reach * Math.cos(mark.bearing_enu_rad),
          north + reach * Math.sin(mark.bearing_enu_rad)];
        add(this.line([[east, north], end], { color, weight: 1, opacity, className: "bearing" }));
      }
    },
    drawEstimate(estimate, add) {
      if (!estimate) return;
      add(this.area(estimate.ellipse,
        { color: COLOURS.estimate, weight: 2, fillOpacity: 0.25, className: "ellipse" }));
      add(this.ring(estimate.place, estimate.r95_m,
        { color: COLOURS.estimate, weight: 1, dashArray: "2 4", className: "r95" }));
      add(this.dot(estimate.place, 4,
        { color: COLOURS.estimate, fillOpacity: 1, className: "estimate" }));
      if (estimate.alternative) {
        add(this.dot(estimate.alternative, 6, { color: COLOURS.second, className: "second" }));
      }
    },
    drawOthers(emitters, add) {
      for (const emitter of emitters) {
        if (emitter.is_current || !emitter.place) continue;
        const color = emitter.is_reported ? COLOURS.reported : COLOURS.other;
        add(this.ring(emitter.place, emitter.r95_m,
          { color, weight: 1, dashArray: "2 4", className: "other-r95" }));
        add(this.dot(emitter.place, 5, { color, fillOpacity: 0.6, className: "other-emitter" }));
      }
    },
    drawPlan(picture, add) {
      if (!picture.waypoint) return;
      if (picture.vehicle) {
        add(this.line([picture.vehicle.slice(0, 2), picture.waypoint.place],
          { color: COLOURS.waypoint, weight: 1, dashArray: "4 4" }));
      }
      add(this.dot(picture.waypoint.place, 5, { color: COLOURS.waypoint, className: "waypoint" }));
    },
  },
};
